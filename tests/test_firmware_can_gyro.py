"""The gyro on CAN: samples and their numbers, time marks, losses, configuration and self-test."""

import struct
from itertools import pairwise

import pytest
from fake_boards import FakeGyroBoard
from raw_can import PREPARE, RESET_NODE, SECOND, START, STOP, RawCanHost, RefusedError

from sim_device.firmware.can_gyro import GyroNode

NODE = 16
RATE_HZ = 250  # of the fake board
AXES = (0x190, 0x490, 0x510)  # identifiers of the samples of each axis


class Gyro:
    """A host with one gyro, in OPERATIONAL."""

    def __init__(self, n_axes: int = 1) -> None:
        self.board = FakeGyroBoard(n_axes)
        self.node = GyroNode(self.board, NODE)
        self.host = RawCanHost(self.node)
        self.host.nmt(START)

    def stream(self, value: int = 1) -> None:
        """Start or stop the stream."""
        self.host.write(0x2020, value, 1)

    def samples(self, axis: int = 0) -> list[tuple[int, int, int]]:
        """Return (number, rate, status) of the samples heard."""
        frames = [struct.unpack("<iI", data) for data in self.host.data(AXES[axis])]
        return [(tail & 0xFFFFFF, rate, tail >> 24) for rate, tail in frames]


@pytest.mark.parametrize("n_axes", [1, 3])
def test_every_sample_comes_with_its_number(n_axes: int) -> None:
    """A stream counts from 0, on one PDO an axis, and no other axis speaks."""
    gyro = Gyro(n_axes)
    gyro.stream()
    gyro.host.run(SECOND)
    for axis in range(3):
        wanted = [(number, 1000 * number + axis, 0) for number in range(RATE_HZ)] if axis < n_axes else []
        assert gyro.samples(axis) == wanted
    gyro.stream(0)
    assert len(gyro.samples()) == RATE_HZ + 1  # the one of this instant
    gyro.host.run(SECOND)
    assert len(gyro.samples()) == RATE_HZ + 1
    assert not gyro.board.sampling


def test_samples_come_in_bursts() -> None:
    """The samples of a burst go out together, when the last has been taken."""
    gyro = Gyro()
    gyro.host.write(0x2013, 10, 1)
    gyro.stream()
    gyro.host.run(100_000)
    instants = [time for time, identifier, _ in gyro.host.heard if identifier == AXES[0]]
    assert instants == [36_000] * 10 + [76_000] * 10


def test_time_mark_precedes_the_first_sample_and_comes_each_slow_period() -> None:
    """Marks tell a sample's number and instant; temperature and tilt come right before."""
    gyro = Gyro()
    gyro.host.run(123_457)
    gyro.stream()
    gyro.host.run(3 * SECOND)
    heard = [(identifier, data) for _, identifier, data in gyro.host.heard if identifier in {0x190, 0x290, 0x390}]
    assert [identifier for identifier, _ in heard[:3]] == [0x390, 0x290, 0x190]
    assert struct.unpack("<h", heard[0][1][:2]) == (-5 * 256,)
    assert [int.from_bytes(heard[0][1][at : at + 3], "little") for at in (2, 5)] == [120, 2**24 - 340]
    marks = [(int.from_bytes(data[:3], "little"), int.from_bytes(data[3:], "little")) for data in gyro.host.data(0x290)]
    assert len(marks) == 3
    for number, time_us in marks:
        assert time_us == 123_457 + number * 4000
    assert all(second[0] - first[0] == RATE_HZ for first, second in pairwise(marks))


def test_starting_twice_changes_nothing_and_stopping_twice_neither() -> None:
    """The stream goes on with its numbers."""
    gyro = Gyro()
    gyro.stream()
    gyro.host.run(400_000)
    gyro.stream()
    gyro.host.run(400_000)
    assert gyro.board.n_starts == 1
    assert [number for number, _, _ in gyro.samples()] == list(range(200))
    gyro.stream(0)
    gyro.stream(0)
    gyro.host.forget()
    gyro.stream()
    gyro.host.run(200_000)
    assert gyro.samples()[0][0] == 0


@pytest.mark.parametrize("command", [STOP, PREPARE, RESET_NODE])
def test_leaving_operational_stops_the_stream(command: int) -> None:
    """The host has to ask again, in OPERATIONAL."""
    gyro = Gyro()
    gyro.stream()
    gyro.host.nmt(command)
    assert not gyro.board.sampling
    gyro.host.nmt(START)
    gyro.host.run(SECOND)
    assert gyro.samples() == []
    assert gyro.host.read(0x2020) == 0
    gyro.host.nmt(PREPARE)
    with pytest.raises(RefusedError, match="08000022"):
        gyro.stream()


def test_numbers_wrap_at_24_bits() -> None:
    """After 2^24 - 1 comes 0."""
    gyro = Gyro()
    gyro.stream()
    gyro.node._next = 2**24 - 2
    gyro.board.n_read = 5
    gyro.board.started_us = -(2**24 - 2) * 4000
    gyro.host.run(200_000)
    assert [number for number, _, _ in gyro.samples()[:4]] == [2**24 - 2, 2**24 - 1, 0, 1]


def test_lost_samples_are_counted_and_flagged() -> None:
    """A burst that the bus does not take is missing in the numbers, counted, reported, and flagged in the next."""
    gyro = Gyro()
    gyro.stream()
    gyro.host.run(200_000)
    gyro.node.room = 10
    gyro.host.run(200_000)
    gyro.node.room = None
    gyro.host.run(200_000)
    numbers = [number for number, _, _ in gyro.samples()]
    assert numbers == [*range(50), *range(100, 150)]
    assert {status for number, _, status in gyro.samples() if number >= 100} == {1 << 4}
    assert gyro.host.read(0x2107) == 50
    assert gyro.host.data(0x80 + NODE) == [struct.pack("<HB5x", 0x8110, 0)]


def test_status_bits_and_the_sensor_fault() -> None:
    """Status goes with the samples; a sensor fault is an emergency, once."""
    gyro = Gyro()
    gyro.board.flags = 1 | 4
    gyro.stream()
    gyro.host.run(SECOND)
    assert {status for _, _, status in gyro.samples()} == {5}
    assert gyro.host.data(0x80 + NODE) == [struct.pack("<HB5x", 0x5030, 0x81)]


def test_configuration() -> None:
    """The gyro tells what it is; its own sample rate is accepted, another refused; a burst stays while streaming."""
    gyro = Gyro(3)
    read, write = gyro.host.read, gyro.host.write
    assert (read(0x2010), read(0x2011), read(0x2012), read(0x2013)) == (250_000, 5000, 3, 50)
    assert (read(0x2002), read(0x1018, 4)) == (3, 1)
    write(0x2010, 250_000, 4)
    with pytest.raises(RefusedError, match="06090030"):
        write(0x2010, 500_000, 4)
    gyro.stream()
    with pytest.raises(RefusedError, match="08000022"):
        write(0x2013, 10, 1)


def test_self_test() -> None:
    """It takes its time and tells its failures; not while streaming, and no stream meanwhile."""
    gyro = Gyro()
    start = (0x2030, 1, 1)
    gyro.host.write(*start, subindex=1)
    assert gyro.host.read(0x2030, 2) == 1
    with pytest.raises(RefusedError, match="08000022"):
        gyro.stream()
    with pytest.raises(RefusedError, match="08000022"):
        gyro.host.write(*start, subindex=1)
    gyro.host.run(700_000)
    assert (gyro.host.read(0x2030, 2), gyro.host.read(0x2030, 3)) == (2, 1 << 2)
    gyro.stream()
    with pytest.raises(RefusedError, match="08000022"):
        gyro.host.write(*start, subindex=1)


def test_samples_seen() -> None:
    """What the host says that it has read is taken as an instant, never beyond what was sent."""
    gyro = Gyro()
    gyro.host.run(50_000)
    gyro.stream()
    gyro.host.run(SECOND)
    assert gyro.node.seen_time_us == 0
    gyro.host.send(0x210, struct.pack("<I", 26))
    assert gyro.node.seen_time_us == 50_000 + 25 * 4000
    gyro.host.send(0x210, struct.pack("<I", 2**32 - 1))
    assert gyro.node.seen_time_us == 50_000 + 249 * 4000
