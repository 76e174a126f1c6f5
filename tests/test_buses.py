"""The emulated buses: socketcand, slcan, python-can's virtual bus, faults of the bus, and the emulator as a process."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import re
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.can_bench import BUS_OFF, EXTENDED, REMOTE, RESTARTED, CanBench, Tap
from sim_device.can_server import schedule_bus
from sim_device.faults import FaultSpec
from sim_device.pace import REST_PATIENCE_US, Pace
from sim_device.server import main
from sim_device.slcan import Adapter
from sim_device.socketcand import Conversation
from sim_device.virtual_bus import BusPump

ROOT = Path(__file__).parents[1]
BOOT_UPS = [(0x720, b"\x00"), (0x721, b"\x00"), (0x710, b"\x00")]
GYRO_START = (0x610, b"\x2f\x20\x20\x00\x01\x00\x00\x00")
SECOND = 1_000_000
PATIENCE = 60.0  #: s, for what comes at once on a machine that is not busy


def _bench(faults: tuple[str, ...] = (), **options: Any) -> tuple[CanBench, Tap]:  # noqa: ANN401 - those of CanBench
    """Return a bench that has booted up, and a host's tap that has heard so."""
    bench = CanBench("ideal", seed=1, **options)
    schedule_bus([FaultSpec.parse(fault) for fault in faults], bench)
    tap = bench.wire.tap()
    bench.advance_to(0)
    assert _heard(tap) == BOOT_UPS
    return bench, tap


def _heard(tap: Tap) -> list[tuple[int, bytes]]:
    """Return what a tap has heard since it was asked last."""
    frames = [(identifier, data) for _, identifier, data in tap.waiting]
    tap.waiting.clear()
    return frames


# the wire


def test_hosts_hear_nodes_and_each_other_but_not_themselves() -> None:
    """A frame reaches everyone else; a stranger's frames of other formats pass the nodes by."""
    bench, one = _bench()
    other = bench.wire.tap()
    deaf = bench.wire.tap(500_000)
    for identifier in (0x123, 0x123 | EXTENDED, 0x610 | REMOTE, 0x610 | EXTENDED):
        one.send(identifier, bytes(8), bench.now_us)
        assert _heard(other) == [(identifier, bytes(8))]
    assert _heard(one) == []
    assert not deaf.send(0x610, b"\x40\x00\x10\x00\x00\x00\x00\x00", bench.now_us)
    one.send(0x610, b"\x40\x00\x10\x00\x00\x00\x00\x00", bench.now_us)
    assert _heard(one) == _heard(other)[1:] == [(0x590, b"\x43\x00\x10\x00\x00\x00\x00\x00")]
    assert _heard(deaf) == []


def test_bus_off_and_back() -> None:
    """Off the bus nothing passes, either way; both ends of it are told."""
    bench, tap = _bench(("bus:off@0.05+0.2",))
    bench.advance_to(200_000)
    assert _heard(tap) == [(BUS_OFF, bytes(8))]
    assert not tap.send(*GYRO_START, bench.now_us)
    bench.advance_to(320_000)
    assert [identifier for identifier, _ in _heard(tap)] == [RESTARTED, 0x720, 0x721, 0x710]


def test_reset_node_boots_up_with_a_higher_count() -> None:
    """A device that is switched off and on says so, and counts it."""
    bench, tap = _bench(("gyro:reset@1", "stage:reset@2"))
    bench.advance_to(round(1.05 * SECOND))
    assert (0x710, b"\x00") in _heard(tap)
    tap.send(0x610, b"\x40\x02\x20\x00\x00\x00\x00\x00", bench.now_us)
    assert _heard(tap) == [(0x590, b"\x43\x02\x20\x00\x02\x00\x00\x00")]
    bench.advance_to(round(2.05 * SECOND))
    assert {(0x720, b"\x00"), (0x721, b"\x00")} < set(_heard(tap))


def test_frozen_and_lossy_nodes() -> None:
    """A frozen node neither hears nor speaks; a lossy one loses its share of frames, seeded."""
    bench, tap = _bench(("gyro:freeze@1+1",))
    bench.advance_to(2 * SECOND - 1)
    beats = sum(identifier == 0x710 for identifier, _ in _heard(tap))
    assert beats == 9
    bench.advance_to(3 * SECOND)
    assert sum(identifier == 0x710 for identifier, _ in _heard(tap)) == 11
    counts = []
    for _ in range(2):
        bench, tap = _bench()
        schedule_bus([FaultSpec.parse("gyro:drop=0.2")], bench)
        bench.advance_to(100 * SECOND)
        counts.append(sum(identifier == 0x710 for identifier, _ in _heard(tap)))
    assert counts[0] == counts[1] == pytest.approx(800, abs=5 * (1000 * 0.2 * 0.8) ** 0.5)


@pytest.mark.parametrize("fault", ["gyro:flip=0.1", "stage:delay=5", "gyro:unplug@1", "bus:reset@1", "bus:e-stop@1"])
def test_faults_that_no_bus_has(fault: str) -> None:
    """Faults of a serial line, or of nothing, are refused by name."""
    with pytest.raises(ValueError, match=re.escape(fault)):
        schedule_bus([FaultSpec.parse(fault)], CanBench("ideal"))


# socketcand


def _raw_client(bench: CanBench) -> Conversation:
    client = Conversation(bench.wire)
    client.feed(b"< open can0 >< rawmode >", bench.now_us)
    assert bytes(client.out) == b"< hi >< ok >< ok >"
    client.out.clear()
    return client


def test_socketcand_frames_both_ways() -> None:
    """What a client sends reaches the nodes, and their answer is told with the time of the world."""
    bench, tap = _bench()
    client = _raw_client(bench)
    client.feed(b"< send 610 8 40 0 10 0 0 0 0 0 >< send 00000123 0 >", 1_500_000)
    client.collect()
    assert b"< frame 590 1.500000 4300100000000000 >" in client.out
    assert _heard(tap)[-1] == (0x123 | EXTENDED, b"")


def test_socketcand_errors_and_empty_frames() -> None:
    """Error frames have a word of their own; a frame without data keeps its second blank."""
    bench, tap = _bench()
    client = _raw_client(bench)
    tap.send(0x080, b"", 10)
    tap.send(0x12345678 | EXTENDED, b"\x0a", 10)
    bench.wire.switch_off(off=True)
    client.collect()
    assert bytes(client.out) == (
        b"< frame 080 0.000010  >< frame 12345678 0.000010 0A >< error 20000040 0.000010 >"
    )  # fmt: skip


@pytest.mark.parametrize(
    "command",
    [
        b"< send 800 0 >",
        b"< send 123 9 0 0 0 0 0 0 0 0 0 >",
        b"< send 123 2 0 >",
        b"< send 123 1 100 >",
        b"< send xyz 0 >",
        b"< send -12 0 >",
        b"< nonsense >",
        b"< >",
        b"< open vcan7 >",
    ],
)
def test_socketcand_refuses(command: bytes) -> None:
    """A wrong command is answered with an error, and nothing reaches the bus."""
    bench, tap = _bench()
    client = _raw_client(bench)
    client.feed(command, 0)
    assert client.out.startswith(b"< error ")
    assert _heard(tap) == []


def test_socketcand_before_raw_mode() -> None:
    """Without a bus opened there is no raw mode, and no frame either way."""
    bench, tap = _bench()
    client = Conversation(bench.wire)
    client.feed(b"< rawmode >< send 123 0 >< echo >", 0)
    bench.advance_to(SECOND)
    client.collect()
    assert bytes(client.out) == b"< hi >< error unknown command >< error unknown command >< echo >"
    assert 0x123 not in [identifier for identifier, _ in _heard(tap)]


@given(st.lists(st.integers(1, 40), max_size=12))
@settings(max_examples=30, deadline=None)
def test_socketcand_in_any_pieces(sizes: list[int]) -> None:
    """However TCP cuts the text, the same frames reach the bus."""
    bench, tap = _bench()
    client = Conversation(bench.wire)
    text = b"< open can0 >\n< rawmode >\n< send 123 3 1 22 ff >\n< send 7FF 0 >\n"
    cuts = [0, *itertools.accumulate(sizes)]
    for begin, end in itertools.pairwise([*cuts, max(cuts[-1], len(text))]):
        client.feed(text[begin:end], 0)
    assert _heard(tap) == [(0x123, b"\x01\x22\xff"), (0x7FF, b"")]


# slcan


def _told(adapter: Adapter, text: bytes, now_us: int = 0) -> bytes:
    """Return what the adapter answers."""
    adapter.feed(text, now_us)
    adapter.collect()
    out = bytes(adapter.out)
    adapter.out.clear()
    return out


def _open_adapter(bench: CanBench) -> Adapter:
    adapter = Adapter(bench.wire)
    assert _told(adapter, b"S8\rO\r") == b"\r\r"
    return adapter


def test_slcan_session() -> None:
    """The commands of a usual session and their answers, to the byte."""
    bench, _ = _bench()
    adapter = Adapter(bench.wire)
    for command, answer in (
        (b"\r", b"\r"),
        (b"V\r", b"V1013\r"),
        (b"N\r", b"NSIM1\r"),
        (b"O\r", b"\a"),  # no bit rate yet
        (b"C\r", b"\a"),
        (b"S9\r", b"\a"),
        (b"S8\r", b"\r"),
        (b"F\r", b"\a"),
        (b"t1230\r", b"\a"),
        (b"O\r", b"\r"),
        (b"O\r", b"\a"),
        (b"S6\r", b"\a"),
        (b"t61084000100000000000\r", b"z\rt5908" + b"4300100000000000\r"),
        (b"T000001230\r", b"Z\r"),
        (b"r1234\r", b"z\r"),
        (b"R000001238\r", b"Z\r"),
        (b"F\r", b"F00\r"),
        (b"C\r", b"\r"),
        (b"Z1\r", b"\r"),
        (b"O\r", b"\r"),
        (b"t61084000100000000000\r", b"z\rt59084300100000000000" + b"0001\r"),
    ):
        assert _told(adapter, command, 1000) == answer, command


def test_slcan_tells_all_kinds_of_frames() -> None:
    """Short and long identifiers, data and remote frames, each in its form."""
    bench, tap = _bench()
    adapter = _open_adapter(bench)
    for identifier, data, text in (
        (0x123, b"\xab\x01", b"t1232AB01\r"),
        (0x1ABCDEF0 | EXTENDED, b"", b"T1ABCDEF00\r"),
        (0x7FF | REMOTE, bytes(3), b"r7FF3\r"),
        (0x5 | REMOTE | EXTENDED, b"", b"R000000050\r"),
    ):
        tap.send(identifier, data, 0)
        assert _told(adapter, b"") == text
        adapter.feed(text, 0)
        assert _heard(tap) == [(identifier, data)]
        adapter.out.clear()


@pytest.mark.parametrize(
    "command",
    [
        b"t12\r", b"t123\r", b"t1239\r", b"t1231\r", b"t12310\r"[:6] + b"\r", b"t1231GG\r", b"t8000\r", b"t123100 \r",
        b"T2000000000\r", b"r123100\r", b"x\r", b"\xff\xfe\r", b"t+231 0\r", b"S\r", b"Sx\r", b"s12\r", b"Z2\r",
        b"t" * 100 + b"\r",
    ],
)  # fmt: skip
def test_slcan_refuses(command: bytes) -> None:
    """What is no command is answered with BEL, and nothing reaches the bus."""
    bench, tap = _bench()
    adapter = _open_adapter(bench)
    assert _told(adapter, command) == b"\a"
    assert _heard(tap) == []


def test_slcan_at_another_bit_rate() -> None:
    """At another bit rate the adapter hears nothing, is not heard, and says so."""
    bench, tap = _bench()
    for setting in (b"S6\rO\r", b"s031C\rO\r"):
        adapter = Adapter(bench.wire)
        assert _told(adapter, setting) == b"\r\r"
        assert _told(adapter, b"t1230\r") == b"z\r"
        tap.send(0x456, b"", 0)
        assert _told(adapter, b"") == b""
        assert _told(adapter, b"F\r") == b"FA4\r"
    assert _heard(tap) == []


def test_slcan_listens_only() -> None:
    """An adapter opened by L hears, and sends nothing."""
    bench, tap = _bench()
    adapter = Adapter(bench.wire)
    assert _told(adapter, b"S8\rL\r") == b"\r\r"
    assert _told(adapter, b"t1230\r") == b"\a"
    tap.send(0x456, b"", 0)
    assert _told(adapter, b"") == b"t4560\r"


def test_slcan_tells_of_bus_off_and_of_frames_lost() -> None:
    """F has the bits of bus errors and overruns, and clears them."""
    bench, tap = _bench()
    adapter = _open_adapter(bench)
    bench.wire.switch_off(off=True)
    assert _told(adapter, b"t1230\r") == b"z\r"
    bench.wire.switch_off(off=False)
    assert _told(adapter, b"F\r") == b"FA4\r"
    for number in range(8000):
        tap.send(number % 0x700, bytes(8), 0)
        if number % 100 == 0:
            adapter.collect()
    assert 65_536 < len(adapter.out) < 70_000
    adapter.out.clear()
    assert _told(adapter, b"F\r").endswith(b"F08\r")
    assert _told(adapter, b"F\r") == b"F00\r"


@given(st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_slcan_answers_each_line_and_survives_any(text: bytes) -> None:
    """Whatever comes, each CR is answered with exactly one CR or BEL."""
    bench, _ = _bench()
    adapter = Adapter(bench.wire)
    adapter.feed(text, 0)
    assert len(re.findall(rb"[\r\a]", bytes(adapter.out))) == text.count(b"\r")


# python-can's buses


def test_virtual_bus_in_virtual_time() -> None:
    """A stream passes over a bus of python-can without threads or waiting, stamped with the world's time."""
    bench = CanBench("ideal", seed=1)
    address: dict[str, Any] = {"interface": "virtual", "channel": "in virtual time"}
    with can.Bus(**address) as theirs, can.Bus(**address, preserve_timestamps=True) as ours:
        pump = BusPump(bench, theirs)
        ours.send(can.Message(arbitration_id=0, data=b"\x01\x10", is_extended_id=False))
        ours.send(can.Message(arbitration_id=0x610, data=GYRO_START[1], is_extended_id=False))
        for now_us in range(0, 2 * SECOND + 1, 100_000):
            pump.step(now_us)
        heard = list(iter(lambda: ours.recv(0), None))
        numbers = [
            struct.unpack("<iI", message.data)[1] & 0xFFFFFF for message in heard if message.arbitration_id == 0x190
        ]
        assert numbers == list(range(len(numbers)))
        assert len(numbers) >= 1.8 * bench.gyro_board.sample_rate_millihz / 1000


# the process

Server = dict[str, Any]
Start = Callable[..., Server]


@pytest.fixture
def start() -> Iterator[Start]:
    """Return a function that starts the emulator with options and gives what it announced."""
    with contextlib.ExitStack() as stack:

        def begin(*options: str) -> Server:
            command = [sys.executable, "-m", "sim_device", "--parent-death", *options]
            process = stack.enter_context(
                subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            announced: Server = json.loads(process.stdout.readline())
            return announced

        yield begin


def _bus(address: str) -> can.BusABC:
    """Open the bus of a device's address, INTERFACE:CHANNEL@BITRATE/NODES behind the driver's name."""
    _, interface, channel = address.split(":", 2)
    channel, _, bitrate = channel.rpartition("/")[0].rpartition("@")
    options: dict[str, Any] = {"channel": channel, "bitrate": int(bitrate), "sleep_after_open": 0}
    if interface == "socketcand":
        host, port, name = channel.split(":")
        options = {"host": host, "port": int(port), "channel": name, "tcp_tune": True}
    return can.Bus(interface=interface, **options)


def _stream(bus: can.BusABC, n_samples: int, patience: float = PATIENCE) -> int:
    """Read a gyro's samples without a gap, acknowledging, up to so many or the bus' end; return how many came."""
    for identifier, data in ((0, b"\x01\x10"), GYRO_START):
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
    n_seen = 0
    with contextlib.suppress(can.CanError, OSError):
        while n_seen < n_samples and (message := bus.recv(patience)) is not None:
            if message.arbitration_id != 0x190:
                continue
            assert struct.unpack("<iI", message.data)[1] & 0xFFFFFF == n_seen
            n_seen += 1
            if n_seen % 20 == 0:
                seen = struct.pack("<I", n_seen)
                bus.send(can.Message(arbitration_id=0x210, data=seen, is_extended_id=False))
    return n_seen


def test_pace_is_a_lockstep_with_the_host() -> None:
    """As fast as its host the world needs no time; it holds where the host has not said what it has read."""
    bench, tap = _bench()
    pace = Pace(bench, math.inf)
    tap.send(0, b"\x01\x10", 0)
    tap.send(*GYRO_START, 0)

    def run_ahead() -> int:
        while pace.run_ahead():
            pass
        return sum(identifier == 0x190 for identifier, _ in _heard(tap))

    pace.advance(0)
    n_seen = 0
    while bench.now_us < 100 * SECOND:
        n_new = run_ahead()
        assert 0 < n_new <= 2 * 47  # two bursts
        n_seen += n_new
        tap.send(0x210, struct.pack("<I", n_seen), bench.now_us)
    assert n_seen == pytest.approx(100 * 235, abs=100)
    assert run_ahead()
    assert not run_ahead()  # no word of the host
    held_us = bench.now_us
    pace.advance(REST_PATIENCE_US)
    assert bench.now_us == held_us
    pace.advance(REST_PATIENCE_US + SECOND)
    assert bench.now_us == held_us + SECOND


@pytest.mark.parametrize(
    ("bus", "pattern"),
    [
        ("socketcand", r"{}:socketcand:127\.0\.0\.1:\d+:can0@1000000/{}"),
        ("slcan", r"{}:slcan:/dev/pts/\d+@1000000/{}"),
    ],
)
def test_addresses(start: Start, bus: str, pattern: str) -> None:
    """The emulator tells the address of each device as a host writes it."""
    announced = start("--bus", bus)
    assert re.fullmatch(pattern.format("canopen-gyro", "16"), announced["gyro"])
    assert re.fullmatch(pattern.format("cia402-stage", "32,33"), announced["stage"])


@pytest.mark.parametrize(("bus", "n_samples"), [("socketcand", 20_000), ("slcan", 3_000)])
def test_at_full_speed_the_world_waits_for_its_host(start: Start, bus: str, n_samples: int) -> None:
    """No sample is lost at full speed."""
    announced = start("--bus", bus, "--speed", "max", "--profile", "ideal")
    with _bus(announced["gyro"]) as host:
        assert _stream(host, n_samples) == n_samples


def test_several_clients_of_one_bus(start: Start) -> None:
    """A second client hears what the first one sends, and the nodes' answers; clients come and go."""
    announced = start("--bus", "socketcand")
    with _bus(announced["gyro"]) as one, _bus(announced["stage"]) as other:
        one.send(can.Message(arbitration_id=0x620, data=b"\x40\x00\x10\x00\x00\x00\x00\x00", is_extended_id=False))
        wanted = {0x620, 0x5A0}
        heard = (frame.arbitration_id for frame in iter(lambda: other.recv(PATIENCE), None))
        assert list(itertools.islice((identifier for identifier in heard if identifier in wanted), 2)) == [0x620, 0x5A0]
        answer = next(frame for frame in iter(lambda: one.recv(PATIENCE), None) if frame.arbitration_id == 0x5A0)
        assert bytes(answer.data) == bytes.fromhex("4300100092010200")
    with _bus(announced["gyro"]) as third:
        assert third.recv(PATIENCE) is not None


def test_unplugged_bus(start: Start) -> None:
    """Up to where the adapter is unplugged no sample is missing, then nothing comes any more."""
    announced = start("--bus", "socketcand", "--speed", "max", "--profile", "ideal", "--fault", "bus:unplug@30")
    with _bus(announced["gyro"]) as host:
        assert 235 < _stream(host, 40 * 235, patience=3.0) <= 30 * 235


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--bus", "socketcand", "--fault", "gyro:delay=5"], "gyro:delay=5"),
        (["--bus", "slcan", "--seed", "-1"], "seed"),
        (["--fault", "bus:off@1"], "bus:off@1"),
    ],
)
def test_wrong_options(options: list[str], complaint: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong option ends the emulator at once, with a sentence that names it."""
    assert main(options) == 2
    assert complaint in capsys.readouterr().err


def test_stranger_at_half_the_bus_load(start: Start) -> None:
    """Frames of no concern, thousands a second, disturb neither the stream nor the nodes."""
    announced = start("--bus", "socketcand", "--speed", "max", "--profile", "ideal")
    stop = threading.Event()

    def chatter() -> None:
        with _bus(announced["gyro"]) as stranger:
            while not stop.wait(0.005):
                for number in range(20):
                    frame = can.Message(arbitration_id=0x400 + number, data=bytes(8), is_extended_id=False)
                    stranger.send(frame)

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        with _bus(announced["gyro"]) as host:
            assert _stream(host, 5000) == 5000
    finally:
        stop.set()
        thread.join()
