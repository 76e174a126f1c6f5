"""The conversation, alike in both devices: golden answers, requests executed once, refusals, any bytes at all."""

import struct

import pytest
from fake_boards import FakeGyroBoard, FakeStageBoard
from fake_host import (
    ACK,
    CLEAR_FAULT,
    GET_CONFIG,
    HASH,
    HOME,
    MOVE,
    SELF_TEST,
    SESSION,
    STATUS,
    STREAM_START,
    FakeHost,
    frame,
    heartbeat,
    hello,
    refusal,
    reply,
    request,
    target,
)
from golden import ARCSEC, CELSIUS, DPH, GOLDEN
from hypothesis import given
from hypothesis import strategies as st

from sim_device.firmware.gyro import GyroDevice
from sim_device.firmware.stage import StageDevice

GOLDEN_FRAMES = {golden.name: golden.frame for golden in GOLDEN}


class GoldenGyroBoard(FakeGyroBoard):
    """The gyro of the golden frames."""

    model = "tvg43"
    serial_number = "TVG43-0017"
    boot_count = 7
    sample_rate_millihz = 235_000
    range_dph = 1_080_000

    def self_test(self) -> int:
        """Report resonator drive and tilt sensor."""
        return 1 << 2 | 1 << 4

    def sample_time_us(self, index: int) -> int:
        """Take a sample each 4255 us, which is 235 a second to the microsecond."""
        return self.started_us + index * 4255

    def read_samples(self, n: int) -> bytes:
        """Give the rates of the golden frame."""
        return struct.pack(f"<{n}i", *(round(rate * DPH) for rate in (43.5, -253.75, 38.25)))

    def temperature(self) -> int:
        """Give 24.5 degrees Celsius."""
        return 49 * CELSIUS // 2

    def tilt(self) -> tuple[int, int]:
        """Give 30 and -12.5 arcsec."""
        return (30 * ARCSEC, -25 * ARCSEC // 2)


def _host(kind: str) -> FakeHost:
    return FakeHost(GyroDevice(FakeGyroBoard()) if kind == "gyro" else StageDevice(FakeStageBoard()))


either = pytest.mark.parametrize("kind", ["gyro", "stage"])


def test_gyro_says_the_golden_frames() -> None:
    """Asked with golden frames, a gyro answers with golden frames."""
    gyro = GyroDevice(GoldenGyroBoard())
    gyro.feed(GOLDEN_FRAMES["HELLO"], 12_345_678)
    assert gyro.poll(12_345_678) == GOLDEN_FRAMES["IDENTITY, gyro"]
    gyro.feed(GOLDEN_FRAMES["SET_CONFIG_GYRO"], 12_400_000)
    assert gyro.poll(12_400_000) == GOLDEN_FRAMES["GYRO_CONFIG"]
    gyro.feed(request(SELF_TEST, 3), 12_500_000)
    assert gyro.poll(13_199_999) == b""
    assert gyro.poll(13_200_000) == GOLDEN_FRAMES["SELF_TEST_RESULT"]
    gyro.feed(GOLDEN_FRAMES["STREAM_START"], 15_000_000)
    assert gyro.poll(15_000_000) == GOLDEN_FRAMES["ACK"]
    gyro.feed(GOLDEN_FRAMES["HEARTBEAT"], 15_000_000)
    assert gyro.seen_time_us == 93_500_000


def test_gyro_sends_the_golden_samples() -> None:
    """The state of the golden SAMPLES frame gives that frame."""
    board = GoldenGyroBoard()
    gyro = GyroDevice(board)
    started_us = 20_000_123 - 4700 * 4255
    gyro.feed(hello() + request(STREAM_START, 1), started_us)
    gyro.poll(started_us)
    board.flags = 1 << 1
    gyro._next_index, gyro._block_samples, gyro._n_overruns = 4700, 3, 2
    assert gyro.poll(20_000_123 + 2 * 4255) == GOLDEN_FRAMES["SAMPLES, one axis"]


def test_stage_says_the_golden_frames() -> None:
    """A stage built like the golden one answers with its configuration, and refuses the same target."""
    stage = StageDevice(FakeStageBoard())
    host = FakeHost(stage)
    host.send(hello())
    assert frame(host.send(request(GET_CONFIG, 6))[0]) == GOLDEN_FRAMES["STAGE_CONFIG"]
    host.send(hello())
    host.send(request(HOME, 1))
    host.run_to_rest()
    stage.feed(request(MOVE, 5, target(0, 3_420_001)), host.now_us)
    assert stage.poll(host.now_us) == GOLDEN_FRAMES["ERROR"]


@either
@pytest.mark.parametrize(
    "greeting",
    [hello(version=2), hello(version=0), hello(definition_hash=HASH ^ 1), hello(0)],
    ids=["newer", "older", "other hash", "session 0"],
)
def test_refused_hello_leaves_nothing_open(kind: str, greeting: bytes) -> None:
    """Another version or definition is answered with session 0, ends the session before, and nothing else works."""
    host = _host(kind)
    host.send(hello())
    (answer,) = host.send(greeting)
    assert struct.unpack("<BHII", answer[:11]) == (0x81, 1, HASH, 0)
    assert host.device.session == 0
    for number in (SESSION, 0):
        for code in (GET_CONFIG, SELF_TEST, STREAM_START, HOME):
            assert host.send(request(code, 1, session=number)) == [refusal(1, 3, session=number)]
    assert host.run(3_000_000) == []


@either
def test_silent_before_hello(kind: str) -> None:
    """A device that nobody has greeted says nothing, and refuses requests."""
    host = _host(kind)
    assert host.run(5_000_000) == []
    assert host.send(request(GET_CONFIG, 1)) == [refusal(1, 3)]


@either
def test_identity(kind: str) -> None:
    """The answer to HELLO names the device, its start count and its time."""
    host = _host(kind)
    host.now_us = 5_000_000_000
    answer = host.send(hello())[0]
    assert len(answer) == 64
    session, code, boot, time_us, model, serial = struct.unpack("<IBIQ16s16s", answer[7:56])
    expected = (1, 3, "fake gyro", "G-1") if kind == "gyro" else (2, 4, "fake stage", "S-1")
    assert (code, boot, model.rstrip(b"\0").decode(), serial.rstrip(b"\0").decode()) == expected
    assert (session, time_us) == (SESSION, 5_000_000_000)


@either
def test_duplicate_gets_the_same_reply(kind: str) -> None:
    """A repeated request is answered with the kept reply, even where executing it again would say something else."""
    host = _host(kind)
    host.send(hello())
    asked = request(SELF_TEST, 1)
    host.send(asked)
    assert host.send(asked) == []
    (result,) = [body for body in host.run(1_000_000) if body[0] == 0x85]
    assert result[:9] == reply(0x85, 1)
    assert [body for body in host.send(asked) if body[0] != STATUS] == [result]
    assert [body for body in host.run(1_000_000) if body[0] == 0x85] == []


@either
def test_old_request_is_silent(kind: str) -> None:
    """A request with a number below the last one gets no answer."""
    host = _host(kind)
    host.send(hello())
    host.send(request(GET_CONFIG, 7))
    assert host.send(request(GET_CONFIG, 6)) == []
    assert host.send(request(CLEAR_FAULT, 0)) == []


@either
def test_other_session_is_refused(kind: str) -> None:
    """A request of another session is refused under its own header, and does not use up the number."""
    host = _host(kind)
    host.send(hello())
    assert host.send(request(CLEAR_FAULT, 1, session=99)) == [refusal(1, 3, session=99)]
    assert host.send(request(CLEAR_FAULT, 1))[0] == reply(ACK, 1)


@either
def test_new_hello_restarts_the_numbers(kind: str) -> None:
    """A new session begins at request 1; the old session is gone."""
    host = _host(kind)
    host.send(hello())
    host.send(request(GET_CONFIG, 50))
    host.send(hello(7))
    assert host.device.session == 7
    assert host.send(request(GET_CONFIG, 51)) == [refusal(51, 3)]
    assert host.send(request(CLEAR_FAULT, 1, session=7))[0] == reply(ACK, 1, session=7)


@either
def test_wrong_length_is_refused_and_counted_as_done(kind: str) -> None:
    """A request of known type and wrong length is answered BAD_LENGTH, and again when repeated."""
    host = _host(kind)
    host.send(hello())
    for _ in range(2):
        assert host.send(request(GET_CONFIG, 1, b"x")) == [refusal(1, 2)]
    assert host.device.n_dropped == 0


@either
def test_foreign_frames_are_dropped_and_counted(kind: str) -> None:
    """Unknown types, replies, and HELLO or HEARTBEAT of a wrong length are no conversation."""
    host = _host(kind)
    host.send(hello())
    for body in (b"\x77" * 20, reply(ACK, 1), b"\x01", b"\x02" * 12, b"\x03" * 8):
        assert host.send(frame(body)) == []
    assert host.device.n_dropped == 5


@pytest.mark.parametrize(("kind", "codes"), [("gyro", (0x20, 0x21, 0x22, 0x23)), ("stage", (0x04, 0x10, 0x11))])
def test_request_of_the_other_kind(kind: str, codes: tuple[int, ...]) -> None:
    """A gyro knows no MOVE, a stage no STREAM_START."""
    lengths = {0x21: 16, 0x23: 28, 0x04: 12}
    host = _host(kind)
    host.send(hello())
    for number, code in enumerate(codes, 1):
        assert host.send(request(code, number, bytes(lengths.get(code, 0)))) == [refusal(number, 1)]


@either
def test_seen_time_is_the_newest(kind: str) -> None:
    """A late heartbeat does not set the time back; one of another session counts for nothing."""
    device = GyroDevice(FakeGyroBoard()) if kind == "gyro" else StageDevice(FakeStageBoard())
    device.feed(hello() + heartbeat(500) + heartbeat(400) + heartbeat(900, session=8), 0)
    assert device.seen_time_us == 500
    device.feed(hello(), 0)
    assert device.seen_time_us == 0


@either
def test_self_test_nobody_waits_for(kind: str) -> None:
    """A new request ends the wait for a running self-test; HELLO ends the test itself."""
    host = _host(kind)
    host.send(hello())
    host.send(request(SELF_TEST, 1))
    assert host.send(request(SELF_TEST, 2)) == [refusal(2, 11)]
    start = STREAM_START if kind == "gyro" else HOME
    assert host.send(request(start, 3)) == [refusal(3, 11)]
    assert [body for body in host.run(1_000_000) if body[0] == 0x85] == []
    host.send(request(SELF_TEST, 4))
    host.send(hello())
    assert host.send(request(start, 1))[0] == reply(ACK, 1)
    assert [body for body in host.run(1_000_000) if body[0] == 0x85] == []


#: Anything a line may deliver: noise, and valid frames of valid and invalid content.
deliveries = st.lists(
    st.one_of(
        st.binary(max_size=40),
        st.binary(min_size=1, max_size=64).map(frame),
        st.builds(
            lambda kind, session, number, rest: frame(struct.pack("<BII", kind, session, number) + rest),
            st.sampled_from([2, 3, 4, 5, 6, 0x10, 0x11, 0x20, 0x21, 0x22, 0x23]),
            st.sampled_from([0, SESSION, 1]),
            st.integers(0, 5) | st.integers(0, 2**32 - 1),
            st.sampled_from([0, 4, 12, 16, 28]).flatmap(lambda n: st.binary(min_size=n, max_size=n)),
        ),
        st.builds(hello, st.sampled_from([0, SESSION, 9]), version=st.sampled_from([1, 2])),
    ),
    max_size=12,
)


@either
@given(chunks=deliveries)
def test_any_bytes_are_survived(kind: str, chunks: list[bytes]) -> None:
    """Whatever arrives, nothing is raised, all that is said is whole frames, and a new HELLO is answered."""
    host = _host(kind)
    host.beat_us = 0
    for chunk in chunks:
        host.send(chunk)
        host.run(50_000)
    answer = next(body for body in host.send(b"\x00" + hello(77)) if body[0] == 0x81)
    assert struct.unpack("<I", answer[7:11]) == (77,)


@given(chunks=st.lists(st.one_of(st.binary(max_size=40), st.binary(min_size=1, max_size=64).map(frame)), max_size=12))
def test_noise_never_moves_the_stage(chunks: list[bytes]) -> None:
    """Without a session and a request in it nothing drives the stage, valid frames of random content included."""
    board = FakeStageBoard()
    host = FakeHost(StageDevice(board))
    moving = [request(HOME, 1), request(MOVE, 2, target(36_000, 0)), hello(version=3), request(HOME, 3)]
    for chunk in [*chunks, b"\x00", *moving]:
        host.send(chunk)
        host.run(20_000)
    assert board.path == []
