"""The whole way over emulated buses: command line, drivers, real sockets and pseudo-terminals, emulator process."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.api import StageMode
from drivers.discovery import open_gyro, open_stage
from drivers.errors import DeviceError, DeviceTimeoutError, LinkError
from drivers.transport.can_address import parse_bus_address
from drivers.transport.can_bus import open_bus
from drivers.transport.clock import SystemClock
from drivers.transport.virtual import VirtualClock
from sim_device.can_bench import CanBench
from sim_device.virtual_bus import BusPump

BUSES = ["socketcand", pytest.param("slcan", marks=pytest.mark.skipif(sys.platform == "win32", reason="needs a pty"))]
PATIENCE = 60.0  #: s, for what comes at once on a machine that is not busy
LOGGED = [
    "gyro 16 heartbeat, pre-operational", "NMT start, node 16", "gyro 16 SDO read Number of axes (2012:0): 1",
    "gyro 16 SDO written Stream (2020:0)", "TPDO 1: Rate, axis 1 ", "TPDO 3: Temperature ", "RPDO 1: Samples seen ",
    "axis 32 heartbeat",
]  # fmt: skip


@contextmanager
def emulator(*arguments: str) -> Iterator[dict[str, str]]:
    """Yield what an emulator process announces; end it afterwards."""
    child = subprocess.Popen(
        [sys.executable, "-m", "sim_device", "--parent-death", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout is not None
        announcement: dict[str, str] = json.loads(child.stdout.readline())
        yield announcement
    finally:
        child.terminate()
        child.communicate()


def northfinder(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line."""
    return subprocess.run(
        [sys.executable, "-m", "northfinder", *arguments], capture_output=True, text=True, check=False, timeout=60
    )


@pytest.mark.parametrize("bus", BUSES)
def test_find_over_an_emulated_bus(bus: str, tmp_path: Path) -> None:
    """`find --bus` measures on the emulated bus: no sample lost, and the truth within four standard deviations."""
    done = northfinder(
        "find", "--bus", bus, "--json", "--quiet", "--speed", "max", "--plan", "six-position", "--dwell", "5",
        "--seed", "3", "--sim-azimuth", "217", "--out", str(tmp_path),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    error = (result["azimuth_deg"] - 217 + 180) % 360 - 180
    assert abs(error) < 4 * result["azimuth_sd_deg"]
    assert result["n_lost"] == 0
    assert result["n_samples"] > 235 * 40


def test_a_bus_goes_in_the_middle_of_a_run(tmp_path: Path) -> None:
    """An adapter pulled out ends the measurement with one sentence and the exit code of devices."""
    with emulator("--bus", "socketcand", "--speed", "max", "--fault", "bus:unplug@40") as addresses:
        done = northfinder(
            "find", "--gyro", addresses["gyro"], "--stage", addresses["stage"], "--profile", "tvg43", "--quiet",
            "--plan", "six-position", "--dwell", "5", "--out", str(tmp_path),
        )  # fmt: skip
    assert done.returncode == 3
    assert "was unplugged" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_bus_off_over_socketcand() -> None:
    """Error frames of a controller that has gone off the bus end both drivers' use of it."""
    with emulator("--bus", "socketcand", "--speed", "max", "--fault", "bus:off@10") as addresses:
        clock = SystemClock()
        gyro, stage = open_gyro(addresses["gyro"], clock), open_stage(addresses["stage"], clock)

        def use() -> None:
            gyro.connect()
            stage.connect()
            gyro.start()
            deadline = clock.now() + PATIENCE
            while clock.now() < deadline:
                gyro.read()
                stage.state()
                clock.wait(clock.now() + 0.05)

        try:
            with pytest.raises(LinkError, match="off the bus"):
                use()
        finally:
            stage.close()
            gyro.close()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
def test_another_bit_rate_is_pointed_out() -> None:
    """An adapter set to another bit rate hears errors only: the gyro's timeout asks for the bit rate."""
    with emulator("--bus", "slcan") as addresses:
        clock = SystemClock()
        gyro = open_gyro(addresses["gyro"].replace("@1000000", "@500000"), clock)
        with pytest.raises(DeviceTimeoutError, match="bit rate"):
            gyro.connect()
        gyro.close()


class Lockstep:
    """A bench on a bus of python-can in virtual time, which waits until the host's reader has heard each frame.

    Its link to the host's end must be opened after the drivers' own: the reader then hands it each frame last.
    """

    def __init__(self, bench: CanBench, bus: can.BusABC, clock: VirtualClock, host_end: str) -> None:
        self._bench = bench
        self._pump = BusPump(bench, bus)
        self._clock = clock
        self._reader = SystemClock()
        self._heard = open_bus(parse_bus_address(host_end), self._reader)
        self._n_heard = 0
        clock.attach(self)

    def due_us(self) -> int | None:
        """Return when something happens on the bench."""
        return self._clock.now_us if self._exchange(self._clock.now_us) else self._bench.next_due_us()

    def act(self, at_us: int) -> None:
        """Let happen what is due."""
        self._exchange(at_us)

    def _exchange(self, now_us: int) -> bool:
        """Take frames across; return whether the bench has said something."""
        self._pump.step(now_us)
        news = self._n_heard < self._pump.n_sent
        deadline = time.monotonic() + PATIENCE
        while self._n_heard < self._pump.n_sent:
            assert time.monotonic() < deadline
            self._reader.wait(deadline)
            self._n_heard += len(self._heard.receive())
        return news

    def close(self) -> None:
        """Leave the bus."""
        self._heard.close()


def test_the_drivers_on_the_bus_of_a_program() -> None:
    """Over python-can's virtual interface: connect, home, stream, no sample lost."""
    clock = VirtualClock()
    with can.Bus("end-to-end", interface="virtual") as bus:
        gyro = open_gyro("canopen-gyro:virtual:end-to-end/16", clock)
        stage = open_stage("cia402-stage:virtual:end-to-end/32,33", clock)
        lockstep = Lockstep(CanBench("tvg43", seed=1), bus, clock, "virtual:end-to-end")
        try:
            gyro.connect()
            stage.connect()
            stage.home()
            gyro.start()
            begin, blocks = clock.now(), gyro.read()
            while stage.state().mode is not StageMode.IDLE and clock.now() < begin + 120:
                blocks += gyro.read()
                clock.wait(clock.now() + 0.05)
            assert stage.state().mode is StageMode.IDLE
            n_samples = sum(len(block.counts) for block in blocks)
            assert n_samples == pytest.approx((clock.now() - begin) * gyro.sample_rate, abs=100)
            assert not any(block.n_lost for block in blocks)
        finally:
            stage.close()
            gyro.close()
            lockstep.close()


@contextmanager
def ending(child: subprocess.Popen[bytes]) -> Iterator[None]:
    """End a program, whatever has happened."""
    try:
        yield
    finally:
        child.terminate()


@pytest.mark.skipif(sys.platform == "win32", reason="no such signal")
def test_canlog_names_what_passes(tmp_path: Path) -> None:
    """The log of a bus reads in names, and reads the same from its recording; a stranger's frames stay numbers."""
    tool = Path(__file__).parent.parent / "tools" / "canlog.py"
    recording, shown = tmp_path / "bench.asc", tmp_path / "shown.txt"
    clock = SystemClock()
    deadline = clock.now() + PATIENCE
    with emulator("--bus", "socketcand", "--speed", "5") as addresses, shown.open("w") as out:
        where = addresses["gyro"].removeprefix("canopen-gyro:").rpartition("/")[0]
        command = [sys.executable, "-u", str(tool), where, "--out", str(recording)]
        with subprocess.Popen(command, stdout=out) as log, ending(log):
            while not shown.stat().st_size and clock.now() < deadline:
                clock.wait(clock.now() + 0.05)
            with closing(open_gyro(addresses["gyro"], clock)) as gyro:
                gyro.connect()
                gyro.start()
                while not all(part in shown.read_text() for part in LOGGED) and clock.now() < deadline:
                    gyro.read()
                    clock.wait(clock.now() + 0.05)
        assert log.returncode == 0
    text = shown.read_text()
    for part in LOGGED:
        assert part in text, part
    again = subprocess.run([sys.executable, str(tool), str(recording)], capture_output=True, text=True, check=True)
    named = [[line[16:] for line in log_text.splitlines()] for log_text in (text, again.stdout)]
    assert named[0] == named[1][: len(named[0])]
    assert len(named[1]) - len(named[0]) <= 1  # recorded, and not yet shown when the log was ended


def test_a_vcan_carries_the_bench_too() -> None:
    """Where the kernel has vcan0, the drivers find the bench on it as on any bus."""
    try:
        bus = can.Bus("vcan0", interface="socketcan")
    except (OSError, can.CanError):
        pytest.skip("no vcan0 on this machine")
    clock, stop = SystemClock(), threading.Event()
    with bus:
        pump = threading.Thread(target=BusPump(CanBench("tvg43", seed=1), bus).run, args=(stop,), daemon=True)
        pump.start()
        gyro = open_gyro("canopen-gyro:socketcan:vcan0/16", clock)
        try:
            assert gyro.connect().model == "tvg43"
        except DeviceError as error:
            pytest.fail(str(error))
        finally:
            gyro.close()
            stop.set()
            pump.join(PATIENCE)
