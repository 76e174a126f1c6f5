"""The gyro's firmware: configuration, self-test, the stream and what happens when the line is too slow."""

import struct

import pytest
from fake_boards import FakeGyroBoard
from fake_host import (
    ACK,
    GET_CONFIG,
    SAMPLES,
    SELF_TEST,
    SESSION,
    SET_CONFIG_GYRO,
    STREAM_START,
    STREAM_STOP,
    FakeHost,
    bodies,
    hello,
    refusal,
    reply,
    request,
)
from hypothesis import given
from hypothesis import strategies as st

from sim_device.firmware.gyro import GyroDevice

PERIOD_US = 4000  # of the fake board's samples


def _config(rate: int = 0, block: int = 0) -> bytes:
    return struct.pack("<IIBBH", rate, 0, 0, block, 0)


def _connected(n_axes: int = 1) -> tuple[FakeHost, FakeGyroBoard, GyroDevice]:
    board = FakeGyroBoard(n_axes)
    device = GyroDevice(board)
    host = FakeHost(device)
    host.send(hello())
    return host, board, device


def _blocks(heard: list[bytes]) -> list[tuple[int, int, list[int]]]:
    """Return (first index, time, rates) of each SAMPLES frame."""
    blocks = []
    for body in heard:
        if body[0] == SAMPLES:
            _, axes, n, _, session, index, time_us = struct.unpack("<BBBBIIQ", body[:20])
            assert session == SESSION
            blocks.append((index, time_us, list(struct.unpack(f"<{n * axes}i", body[36:]))))
    return blocks


def test_configuration() -> None:
    """0 leaves a value as it is; the answer holds what is in force: at first blocks of 0.2 s."""
    host, _, _ = _connected()
    assert host.ask(GET_CONFIG) == reply(0x83, 1, struct.pack("<IIBBH", 250_000, 5000, 1, 50, 0))
    assert host.ask(SET_CONFIG_GYRO, _config(250_000, 119))[9:] == struct.pack("<IIBBH", 250_000, 5000, 1, 119, 0)
    assert host.ask(SET_CONFIG_GYRO, _config())[9:] == struct.pack("<IIBBH", 250_000, 5000, 1, 119, 0)


@pytest.mark.parametrize(("n_axes", "longest"), [(1, 119), (3, 39)])
def test_configuration_out_of_range(n_axes: int, longest: int) -> None:
    """A sample rate that the board has not, or a block that no frame holds, is refused with the field's offset."""
    host, _, _ = _connected(n_axes)
    assert host.ask(SET_CONFIG_GYRO, _config(249_999)) == refusal(1, 4, 9)
    assert host.ask(SET_CONFIG_GYRO, _config(0, longest + 1)) == refusal(2, 4, 18)
    assert host.ask(SET_CONFIG_GYRO, _config(0, longest))[0] == 0x83
    host.ask(STREAM_START)
    assert [len(rates) for _, _, rates in _blocks(host.run(longest * PERIOD_US))] == [longest * n_axes]


def test_at_work() -> None:
    """While streaming the configuration and the self-test are refused; a second start changes nothing."""
    host, board, _ = _connected()
    host.ask(STREAM_START)
    host.run(300_000)
    assert host.ask(SET_CONFIG_GYRO, _config()) == refusal(2, 10)
    assert host.ask(SELF_TEST) == refusal(3, 10)
    assert host.ask(STREAM_START) == reply(ACK, 4)
    host.run(300_000)
    assert board.n_starts == 1
    assert [index for index, _, _ in _blocks(host.heard)] == [0, 50, 100]


def test_self_test_takes_its_time() -> None:
    """The result comes when the board says that the test is over."""
    host, _, device = _connected()
    host.send(request(SELF_TEST, 1))
    assert device.next_due_us() == 700_000
    assert host.run(699_999) == []
    assert host.run(1) == [reply(0x85, 1, b"\x04\x00")]
    assert device.next_due_us() is None


@given(st.integers(1, 39), st.sampled_from([1, 3]), st.integers(0, 2_000_000), st.integers(0, 400_000))
def test_every_sample_arrives_once_and_in_time(block: int, n_axes: int, start_us: int, duration_us: int) -> None:
    """From start to stop each sample goes out once, with its index and time, at most a block late."""
    host, board, _ = _connected(n_axes)
    host.now_us = start_us
    host.ask(SET_CONFIG_GYRO, _config(0, block))
    host.ask(STREAM_START)
    while host.now_us < start_us + duration_us:
        host.run(min(7000, start_us + duration_us - host.now_us))
        sent = sum(len(rates) for _, _, rates in _blocks(host.heard)) // n_axes
        assert 0 <= (host.now_us - start_us) // PERIOD_US + 1 - sent < block
    found = host.send(request(STREAM_STOP, 3))
    assert found[-1] == reply(ACK, 3)
    assert not board.sampling
    blocks = _blocks(host.heard)
    assert [rate for _, _, rates in blocks for rate in rates] == [
        1000 * index + axis for index in range(duration_us // PERIOD_US + 1) for axis in range(n_axes)
    ]
    for index, time_us, rates in blocks:
        assert rates[0] == 1000 * index
        assert time_us == start_us + index * PERIOD_US
    assert host.run(1_000_000) == []


def test_late_poll_sends_all_blocks() -> None:
    """A poll after a pause does all that was due, in order."""
    host, _, device = _connected()
    host.ask(STREAM_START)
    assert [index for index, _, _ in _blocks(bodies(device.poll(999_999)))] == [0, 50, 100, 150, 200]
    assert device.next_due_us() == 299 * PERIOD_US


def test_slow_line_loses_blocks_and_says_so() -> None:
    """Blocks without room are counted, the next one carries OVERRUN, and the index goes on."""
    host, board, device = _connected()
    board.flags = 1 << 3
    host.ask(STREAM_START)
    assert device.poll(400_000, room=100) == b""
    assert device.poll(500_000, room=0) == b""
    found = bodies(device.poll(999_999, room=600))
    heads = [struct.unpack("<BBBBIIQHhIii", body[:36]) for body in found]
    assert [head[5] for head in heads] == [100, 150]
    assert [head[7] for head in heads] == [1 << 3 | 1 << 4, 1 << 3]
    assert [head[9] for head in heads] == [100, 100]
    assert heads[0][8] == -5 * 256
    assert heads[0][10:] == (120, -340)
    (last,) = bodies(device.poll(1_199_999))
    assert struct.unpack("<HhI", last[20:28]) == (1 << 3 | 1 << 4, -5 * 256, 150)


def test_replies_always_have_room() -> None:
    """A full line costs samples, never a reply."""
    host, _, device = _connected()
    device.feed(request(STREAM_START, 1), host.now_us)
    assert bodies(device.poll(host.now_us, room=0)) == [reply(ACK, 1)]


def test_hello_stops_the_stream() -> None:
    """A new session starts with a silent gyro; its stream begins at 0 again."""
    host, board, device = _connected()
    host.ask(STREAM_START)
    host.run(310_000)
    host.send(hello())
    assert not board.sampling
    assert host.run(1_000_000) == []
    device.feed(request(STREAM_START, 1), host.now_us)
    assert _blocks(host.run(200_000))[0][0] == 0


def test_stop_without_stream() -> None:
    """STREAM_STOP at rest is acknowledged and sends nothing."""
    host, _, _ = _connected()
    assert host.send(request(STREAM_STOP, 1)) == [reply(ACK, 1)]


def test_index_wraps() -> None:
    """After 2^32 samples the index begins at 0 again and the stream goes on."""
    host, board, device = _connected()
    host.ask(SET_CONFIG_GYRO, _config(0, 1))
    host.ask(STREAM_START)
    device._next_index = 2**32 - 1
    found = bodies(device.poll(board.sample_time_us(2**32)))
    assert [struct.unpack("<I", body[8:12]) for body in found] == [(2**32 - 1,), (0,)]
