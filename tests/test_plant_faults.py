"""Faults of the line do what they say, seeded, and are read strictly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from raw_host import IDENTITY, SAMPLES, STREAM_START, Decoder, heartbeat, hello, parse_samples, request

from sim_device.bench import SimBench
from sim_device.faults import FaultSpec, FaultyLine, LinkFaults, link_faults, schedule

SECOND = 1_000_000


def streaming(faults: LinkFaults, seed: int = 1) -> FaultyLine:
    """Return the line of a streaming gyro, with its faults."""
    bench = SimBench("tvg43", seed=2)
    bench.gyro.feed(hello(), 0)
    bench.gyro.feed(request(STREAM_START, 1), 0)
    bench.gyro.poll(0)
    return FaultyLine(bench.gyro, faults, seed)


def listen(line: FaultyLine, seconds: float) -> list[bytes]:
    """Return the chunks that come within a time."""
    now, chunks = 0, []
    while now < seconds * SECOND:
        due = line.next_due_us()
        assert due is not None
        now = max(now, due)
        chunks.append(line.poll(now))
    return [chunk for chunk in chunks if chunk]


def test_no_faults_change_nothing() -> None:
    """Without faults the bytes come through as they are."""
    assert listen(streaming(LinkFaults()), 10) == listen(streaming(LinkFaults(delay_us=0, freezes_us=((0, 0),))), 10)


def test_drops_and_flips_at_their_rates() -> None:
    """Bytes are lost and bits flipped as often as asked for, where the seed says."""
    clean = b"".join(listen(streaming(LinkFaults()), 60))
    sd = math.sqrt(len(clean) * 0.01 * 0.99)
    dropped = b"".join(listen(streaming(LinkFaults(drop=0.01)), 60))
    assert len(clean) - len(dropped) == pytest.approx(0.01 * len(clean), abs=4 * sd)
    flipped = b"".join(listen(streaming(LinkFaults(flip=0.01)), 60))
    differing = np.frombuffer(clean, np.uint8) ^ np.frombuffer(flipped, np.uint8)
    assert np.count_nonzero(differing) == pytest.approx(0.01 * len(clean), abs=4 * sd)
    assert set(np.bitwise_count(differing).tolist()) == {0, 1}
    assert flipped == b"".join(listen(streaming(LinkFaults(flip=0.01)), 60))
    assert flipped != b"".join(listen(streaming(LinkFaults(flip=0.01), seed=9), 60))


def test_duplicates_and_garbage() -> None:
    """A chunk is sent twice, or followed by junk, with the probability asked for."""
    clean = listen(streaming(LinkFaults()), 20)
    assert listen(streaming(LinkFaults(duplicate=1.0)), 20) == [chunk * 2 for chunk in clean]
    noisy = listen(streaming(LinkFaults(garbage=0.5)), 20)
    assert [chunk[: len(whole)] for chunk, whole in zip(noisy, clean, strict=True)] == clean
    n_noisy = sum(len(chunk) > len(whole) for chunk, whole in zip(noisy, clean, strict=True))
    assert n_noisy == pytest.approx(len(clean) / 2, abs=4 * math.sqrt(len(clean)) / 2)


def test_freeze_loses_what_was_said_meanwhile() -> None:
    """A frozen device is not heard; afterwards its index tells what is missing."""
    decoder = Decoder()
    chunks = listen(streaming(LinkFaults(freezes_us=((2 * SECOND, 4 * SECOND),))), 6)
    blocks = [parse_samples(body) for chunk in chunks for body in decoder.feed(chunk) if body[0] == SAMPLES]
    steps = np.diff([block.index for block in blocks])
    assert sorted(steps.tolist())[-2:] == [47, 47 * 11]  # 10 blocks of 0.2 s are missing
    assert decoder.n_damaged == 0


def test_delay_either_way() -> None:
    """What the host says, and the answer to it, take the delay each."""
    bench = SimBench("tvg43", seed=2)
    line = FaultyLine(bench.stage, LinkFaults(delay_us=30_000), 1)
    line.feed(hello(), 0)
    decoder = Decoder()
    heard_at = None
    for now in range(0, 100_000, 1000):
        for body in decoder.feed(line.poll(now)):
            if body[0] == IDENTITY:
                heard_at = now
                assert int.from_bytes(body[16:24], "little") == 30_000  # when the device answered
    assert heard_at == 60_000


def test_unplugged() -> None:
    """From the instant on, any use of an unplugged line is an error that names the device."""
    line = streaming(LinkFaults(unplug_us=SECOND))
    assert line.poll(SECOND - 1)
    assert line.next_due_us() == SECOND
    with pytest.raises(ConnectionResetError, match="gyro has been unplugged"):
        line.poll(SECOND)
    with pytest.raises(ConnectionResetError):
        line.feed(heartbeat(0), 2 * SECOND)


@given(drop=st.floats(0, 1), flip=st.floats(0, 1), data=st.binary(max_size=200), seed=st.integers(0, 1000))
def test_whatever_the_line_does_the_device_goes_on(drop: float, flip: float, data: bytes, seed: int) -> None:
    """Any bytes through any line leave the device able to answer HELLO."""
    bench = SimBench("ideal", seed=seed)
    FaultyLine(bench.gyro, LinkFaults(drop=drop, flip=flip, duplicate=0.5, garbage=0.5), seed).feed(data, 0)
    bench.gyro.feed(b"\0" + hello(), 1000)
    assert [body[0] for body in Decoder().feed(bench.gyro.poll(1000))][-1] == IDENTITY


def test_faults_as_text() -> None:
    """The text form says which device, what, how much, when and for how long."""
    texts = [
        "gyro:drop=1e-3",
        "gyro:delay=20",
        "gyro:freeze@10+2.5",
        "gyro:unplug@60",
        "stage:flip=0.1",
        "gyro:reset@3",
    ]
    specs = [FaultSpec.parse(text) for text in texts]
    assert link_faults(specs, "gyro") == LinkFaults(
        drop=1e-3, delay_us=20_000, freezes_us=((10_000_000, 12_500_000),), unplug_us=60_000_000
    )
    assert link_faults(specs, "stage") == LinkFaults(flip=0.1)
    bench = SimBench("ideal")
    schedule(specs, bench)
    bench.advance_to(4 * SECOND)
    assert bench.gyro_board.boot_count == 2
    assert bench.stage_board.boot_count == 1


def test_e_stop_for_a_while() -> None:
    """The emergency stop is pressed and, with a duration, released again."""
    bench = SimBench("ideal")
    schedule([FaultSpec.parse("stage:e-stop@1+2")], bench)
    pressed = []
    for now in (0, SECOND, 2 * SECOND, 3 * SECOND):
        bench.advance_to(now)
        pressed.append(bench.plant_stage.e_stop)
    assert pressed == [False, True, True, False]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("drop=0.1", "not of the form"),
        ("gyro:reset@1.2.3", "not of the form"),
        ("gyro:drop=2", "needs a value from 0 to 1, got '2'"),
        ("gyro:drop", "needs a value from 0 to 1, got ''"),
        ("gyro:drop=nan", "needs a value from 0 to 1"),
        ("stage:reset", "needs an instant: stage:reset@SECONDS"),
        ("gyro:e-stop@1", "the gyro has no fault 'e-stop'"),
        ("stage:stall=roll@1", "needs an axis, azimuth or elevation, got 'roll'"),
        ("stage:explode@1", "the stage has no fault 'explode'"),
    ],
)
def test_wrong_faults_are_refused(text: str, message: str) -> None:
    """A fault that is misspelt, or lacks something, is refused in one line that says what is needed."""

    def apply() -> None:
        specs = [FaultSpec.parse(text)]
        link_faults(specs, "gyro")
        schedule(specs, SimBench("ideal"))

    with pytest.raises(ValueError, match=message):
        apply()
