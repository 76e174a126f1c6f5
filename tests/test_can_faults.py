"""What goes wrong on a CAN bus, in virtual time: a named error or a clean run, never a wrong sample; random frames."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from math import radians
from pathlib import Path

import numpy as np
import pytest
from can_virtual import CanVirtualBench, can_bench

from drivers.api import StageLimits
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from northfinder.cyclogram import Cyclogram, Step, six_position
from northfinder.record import Record
from sim_device.can_bench import AZIMUTH_ID, ELEVATION_ID, GYRO_ID, CanBench
from sim_device.firmware.can_gyro import GyroNode

SHORT = six_position(10.0)

FAULTS: list[tuple[str, type[Exception], str]] = [
    ("bus:unplug@50", LinkError, "unplugged"),
    ("bus:off@50", LinkError, "off the bus"),
    ("gyro:reset@50", DeviceFaultError, "the gyro, node 16 on virtual:bench was reset"),
    ("stage:reset@50", DeviceFaultError, "axis, node 3[23] on virtual:bench was reset"),
    ("stage:reset@40", DeviceFaultError, "axis, node 3[23] on virtual:bench was reset"),
    ("gyro:freeze@50+9", DeviceTimeoutError, "the gyro, node 16 on virtual:bench has sent no heartbeat"),
    ("stage:freeze@50+9", DeviceTimeoutError, "axis, node 3[23] on virtual:bench has sent no heartbeat"),
    ("gyro:sensor-fault@50", DeviceFaultError, "SENSOR_FAULT"),
    ("stage:stall=azimuth@40", DeviceFaultError, "STALL"),
    ("stage:runaway=azimuth@46", DeviceFaultError, "RUNAWAY"),
    ("stage:runaway=azimuth@50", DeviceFaultError, "RUNAWAY"),
    ("stage:encoder-jump=elevation@50", DeviceFaultError, "ENCODER"),
    ("stage:limit-switch=azimuth@40", DeviceFaultError, "LIMIT_SWITCH"),
    ("stage:e-stop@50", DeviceFaultError, "E_STOP"),
]


@pytest.mark.parametrize(("fault", "kind", "name"), FAULTS, ids=[fault for fault, _, _ in FAULTS])
def test_a_fault_is_named_and_ends_with_the_stage_at_rest(
    tmp_path: Path, fault: str, kind: type[Exception], name: str
) -> None:
    """A fault in the middle of a run: the right error, soon, the stage at rest, and the record kept."""
    bench = can_bench(faults=(fault,))
    with pytest.raises(kind, match=name):
        bench.measure(tmp_path / "r.sqlite", SHORT)
    instant = float(fault.partition("@")[2].partition("+")[0])
    assert instant <= bench.clock.now() <= instant + 6
    if "runaway" not in fault:
        bench.bench.advance_to(bench.bench.now_us + 3_000_000)
        assert bench.bench.plant_stage.rest_since_us() <= bench.bench.now_us - 1_000_000
    with Record(tmp_path / "r.sqlite") as record:
        assert ("state", "failed") in [(kind, detail) for _, kind, detail in record.events()]


@pytest.mark.parametrize("node", [GYRO_ID, AZIMUTH_ID, ELEVATION_ID])
def test_heartbeat_loss_is_found_within_300_ms(node: int) -> None:
    """When a node's heartbeats stop, though all else goes on, it is named within 300 ms of the last one."""
    bench = can_bench()
    gyro, stage = bench.open_gyro(), bench.homed()
    gyro.connect()
    gyro.start()
    bench.stream(gyro, 0.3)
    heartbeat = 0x700 + node
    bench.tap.to_host = lambda identifier, data: [] if identifier == heartbeat else [(identifier, data)]
    last = max(at_us for at_us, identifier, _ in bench.tap.said if identifier == heartbeat)

    def serve() -> None:
        while bench.clock.now() < 100.0:
            stage.state()
            gyro.read()
            bench.clock.wait(bench.clock.now() + 0.05)

    with pytest.raises(DeviceTimeoutError, match=f"node {node} on virtual:bench has sent no heartbeat for 2"):
        serve()
    assert bench.clock.now_us - last <= 310_000


def test_a_missing_node_is_named_with_what_is_heard_instead() -> None:
    """A node that is not there gives a timeout that tells of the others; a silent bus, one that asks for power."""
    bench = can_bench()
    bench.bench.gyro.drop = 1.0
    bench.clock.sleep_until(0.3)
    with pytest.raises(
        DeviceTimeoutError, match=r"the gyro, node 16 .* does not answer; others speak there \(32, 33\)"
    ):
        bench.open_gyro().connect()
    silent = can_bench()
    silent.tap.to_host = lambda identifier, data: []  # noqa: ARG005  # nothing passes
    with pytest.raises(DeviceTimeoutError, match="the bus is silent: is it powered, and is this its bit rate"):
        silent.open_stage().connect()


def test_error_frames_point_to_the_bit_rate() -> None:
    """Where error frames come instead of answers the message asks for bit rate and cable."""
    bench = can_bench()
    bench.tap.to_host = lambda identifier, data: [(1 << 29 | 8, bytes(8))]  # noqa: ARG005  # all is damaged
    gyro = bench.open_gyro()
    with pytest.raises(DeviceTimeoutError, match="error frames came: is the bit rate right"):
        gyro.connect()
    assert gyro.troubles["errors on the bus"] > 0


@pytest.mark.parametrize("nth", [1, 2, 3], ids=["falling edge", "set-point", "end of the handshake"])
def test_a_lost_controlword_of_a_move_is_made_up_for(nth: int) -> None:
    """Of the three that an axis is sent for a move, one is lost: it arrives all the same."""
    bench = can_bench()
    stage = bench.homed()
    n_sent = 0

    def lose(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        nonlocal n_sent
        n_sent += identifier == 0x200 + AZIMUTH_ID
        return [] if identifier == 0x200 + AZIMUTH_ID and n_sent == nth else [(identifier, data)]

    bench.tap.to_bench = lose
    stage.move(radians(20), 0.0)
    state = bench.serve(stage, lambda state: state.in_position, timeout=20.0)
    assert state.azimuth == pytest.approx(radians(20), abs=1e-4)
    assert n_sent >= 3


def test_a_stray_answer_holds_up_no_wait() -> None:
    """An SDO answer that nobody asked for, in the place of a heartbeat, lets the wait for the node end in its time."""
    bench = can_bench()

    def stray(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        started = bench.tap.asked[-1][1:] == (0, bytes([1, GYRO_ID]))
        return [(0x590, bytes(8))] if started and identifier == 0x710 else [(identifier, data)]

    gyro = bench.open_gyro()
    bench.tap.to_host = stray
    with pytest.raises(DeviceTimeoutError, match="has not become OPERATIONAL within 1 s"):
        gyro.connect()
    assert bench.clock.now() < 3.0


class Twin:
    """A second gyro of the same number, made of the same firmware, beside the bench."""

    def __init__(self, serial: int, node_id: int = GYRO_ID) -> None:
        self.world = CanBench("tvg43", seed=serial)
        self.node = GyroNode(self.world.gyro_board, node_id)

    def feed(self, identifier: int, data: bytes, now_us: int) -> None:
        """Take what the node listens to."""
        if self.node.accepts(identifier):
            self.node.feed(identifier, data, now_us)

    def poll(self, now_us: int) -> list[tuple[int, bytes]]:
        """Return what it says."""
        return self.node.poll(now_us)

    def next_due_us(self) -> int | None:
        """Return when it acts."""
        return self.node.next_due_us()


def test_two_nodes_with_one_number_are_found_at_once() -> None:
    """Two gyros that are both node 16 answer twice: connecting says so, with both serial numbers."""
    bench = can_bench(seed=1, others=(Twin(7),))
    with pytest.raises(ProtocolError, match=r"two nodes answer as node 16 on virtual:bench, .* numbers [17] and [17]:"):
        bench.open_gyro().connect()


def test_a_twin_that_comes_later_spoils_no_sample() -> None:
    """A second node 16 plugged in while the first streams: an error, and not one of its samples in any block."""
    bench = can_bench(seed=1)
    gyro = bench.open_gyro()
    gyro.connect()
    gyro.start()
    blocks = bench.stream(gyro, 2.0)
    genuine = _rates(bench)
    n_twin = iter(range(10**9))

    def interleave(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        if identifier == 0x190:
            return [(0x190, (next(n_twin) % 2**24).to_bytes(7, "little") + b"\0"), (identifier, data)]
        return [(identifier, data)]

    bench.tap.to_host = interleave

    def read_on() -> None:
        while bench.clock.now() < 60.0:
            blocks.extend(gyro.read())
            bench.clock.wait(bench.clock.now() + 0.05)

    with pytest.raises(DeviceFaultError, match="was reset, or another node has its number"):
        read_on()
    genuine |= _rates(bench)
    for block in blocks:
        for offset, count in enumerate(block.counts[:, 0].tolist()):
            assert genuine[block.first_index + offset] == count


def _rates(bench: CanVirtualBench) -> dict[int, int]:
    """Return the rate of each sample that the gyro has sent, by number."""
    return {
        int.from_bytes(data[4:7], "little"): int.from_bytes(data[:4], "little", signed=True)
        for _, identifier, data in bench.tap.said
        if identifier == 0x190
    }


class Stranger:
    """Somebody else's traffic: random frames on identifiers of other nodes, or of 29 bits, each `period_us`."""

    def __init__(self, seed: int, period_us: int, taken: set[int]) -> None:
        self._rng = random.Random(seed)
        self._period_us = period_us
        self._due_us = 0
        self._taken = taken
        self.n_sent = 0

    def feed(self, identifier: int, data: bytes, now_us: int) -> None:
        """Ignore."""

    def poll(self, now_us: int) -> list[tuple[int, bytes]]:
        """Chatter."""
        frames = []
        while self._due_us <= now_us:
            self._due_us += self._period_us
            frames.append((self._identifier(), self._rng.randbytes(self._rng.randrange(9))))
        self.n_sent += len(frames)
        return frames

    def next_due_us(self) -> int | None:
        """Return when it speaks next."""
        return self._due_us

    def _identifier(self) -> int:
        while True:
            identifier = self._rng.choice(
                [self._rng.randrange(1, 0x800), 1 << 31 | self._rng.choice([0x190, 0x1A0, 0x710])]
            )
            if identifier & 0x7F not in self._taken or identifier >> 31:
                return identifier


def test_a_strangers_traffic_does_no_harm() -> None:
    """With half the bus taken by a stranger, 4,000 frames a second, the samples are those of a bus to itself."""
    quiet, stranger = can_bench(seed=2), Stranger(1, 250, {0, GYRO_ID, AZIMUTH_ID, ELEVATION_ID, 127})
    busy = can_bench(seed=2, others=(stranger,))
    counts: list[list[int]] = []
    for bench in (quiet, busy):
        gyro = bench.open_gyro()
        gyro.connect()
        gyro.start()
        blocks = bench.stream(gyro, 2.0)
        assert not any(block.n_lost for block in blocks)
        counts.append(np.concatenate([block.counts[:, 0] for block in blocks]).tolist())
    n_common = min(map(len, counts))
    assert n_common > 400
    assert stranger.n_sent > 8000
    assert counts[0][:n_common] == counts[1][:n_common]


def test_lost_frames_are_counted_from_the_number() -> None:
    """Of a bus that loses one frame in fifty every lost sample is counted, and every other one is right."""
    bench = can_bench()
    gyro = bench.open_gyro()
    gyro.connect()
    gyro.start()
    rng = random.Random(3)
    bench.tap.to_host = lambda identifier, data: (
        [] if identifier == 0x190 and rng.random() < 0.02 else [(identifier, data)]
    )
    blocks = bench.stream(gyro, 10.0)
    sent = _rates(bench)
    end = blocks[-1].first_index + len(blocks[-1].counts)
    received = sum(len(block.counts) for block in blocks)
    assert 20 < sum(block.n_lost for block in blocks) == end - received
    for block in blocks:
        assert [sent[block.first_index + i] for i in range(len(block.counts))] == block.counts[:, 0].tolist()


def test_frames_that_come_twice_count_once() -> None:
    """A bus may deliver a frame twice: the samples are as if it had not."""
    bench = can_bench()
    gyro = bench.open_gyro()
    gyro.connect()
    gyro.start()
    bench.tap.to_host = lambda identifier, data: [(identifier, data)] * (2 if identifier == 0x190 else 1)
    blocks = bench.stream(gyro, 2.0)
    assert [block.first_index for block in blocks] == [47 * i for i in range(len(blocks))]
    assert not any(block.n_lost for block in blocks)


def test_the_sample_number_wraps() -> None:
    """Past 2^24 the index goes on counting, though the number on the wire starts again."""
    bench = can_bench()
    gyro = bench.open_gyro()
    gyro.connect()
    gyro.start()
    start = 2**24 - 100

    def shift(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        if identifier == 0x190:
            number = (int.from_bytes(data[4:7], "little") + start) % 2**24
            data = data[:4] + number.to_bytes(3, "little") + data[7:]
        return [(identifier, data)]

    bench.tap.to_host = shift
    gyro._assembler._axes[0]._newest[0, 0] = start - 1  # as if they had all been read
    gyro._assembler._next = start
    blocks = bench.stream(gyro, 2.0)
    assert blocks[0].first_index == start
    assert blocks[-1].first_index > 2**24
    assert not any(block.n_lost for block in blocks)


def test_another_plan_is_refused_before_anything_moves(tmp_path: Path) -> None:
    """A step beyond the limits is refused while the drives have no power."""
    bench = can_bench(
        limits=StageLimits(azimuth_min=0.0, azimuth_max=3.0, elevation_min=-0.1, elevation_max=0.1, max_speed=1.0)
    )
    steps = (SHORT.steps[0], Step(name="west", azimuth=radians(-90), elevation=0.0, dwell=5.0))
    with pytest.raises(Exception, match="azimuth -90 deg cannot be reached"):
        bench.measure(tmp_path / "r.sqlite", Cyclogram(name="west", steps=steps))
    assert bench.bench.plant_stage.rest_since_us() == 0


# Whatever comes


def _noise(rng: random.Random, known: list[tuple[int, bytes]]) -> tuple[int, bytes]:
    """Return a frame: random on an identifier that is listened to, or one that was really sent, changed."""
    if rng.random() < 0.5 or not known:
        base = rng.choice((0x080, 0x180, 0x280, 0x380, 0x480, 0x500, 0x580, 0x700))
        return base + rng.choice((GYRO_ID, AZIMUTH_ID, ELEVATION_ID)), rng.randbytes(rng.randrange(9))
    identifier, data = rng.choice(known)
    changed = bytearray(data)
    if changed:
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return identifier, bytes(changed[: rng.choice((len(changed), rng.randrange(9)))])


def storm(n_frames: int, seed: int) -> int:
    """Hurl frames at both drivers in every state; return how often one of them gave up with a declared exception."""
    rng = random.Random(seed)
    bench = can_bench(seed=seed)
    hurled = failures = 0
    known: list[tuple[int, bytes]] = []

    def hurl(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        nonlocal hurled
        if len(known) < 500:
            known.append((identifier, data))
        noise = [_noise(rng, known) for _ in range(rng.randrange(30))] if rng.random() < 0.2 else []
        hurled += len(noise)
        return [*noise, (identifier, data)]

    bench.tap.to_host = hurl
    while hurled < n_frames:
        gyro, stage = bench.open_gyro(), bench.open_stage()
        for use in (gyro.connect, gyro.start, partial(bench.stream, gyro, 3.0), gyro.stop, stage.connect, stage.home):
            failures += _gives_up(use)
        for _ in range(40):
            failures += _gives_up(stage.state)
            bench.clock.wait(bench.clock.now() + 0.05)
        gyro.close()
        stage.close()
    return failures


def _gives_up(use: Callable[[], object]) -> bool:
    try:
        use()
    except DeviceError:
        return True
    return False


def test_no_frames_raise_anything_but_declared_exceptions() -> None:
    """Twenty thousand random and mutated frames at the drivers in every state end in DeviceError or in nothing."""
    assert storm(20_000, seed=1) > 0


@pytest.mark.campaign
def test_no_million_frames_either() -> None:
    """As above, a million."""
    assert sum(storm(50_000, seed=seed) for seed in range(20)) > 0
