"""The program as a process that a test can interrupt in several ways, on a bench whose true motion the test can see."""

import contextlib
import fcntl
import math
import os
import pty
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

from msgspec.structs import replace

from sim_device import server
from sim_device.bench import SimBench
from sim_device.can_bench import CanBench
from sim_device.can_server import BusConnection, open_port
from sim_device.pace import Pace, WallTime
from sim_device.plant.profile import Profile, load_profile
from sim_device.ports import Connection, PtyPort
from sim_device.server import LOOPBACK, Served

SIGNALS = {"Ctrl-C": signal.SIGINT, "SIGTERM": signal.SIGTERM, "SIGHUP": signal.SIGHUP}
#: Signals, a terminal that is closed, and a Ctrl-C while nobody takes what the program says.
INTERRUPTIONS = (*SIGNALS, "closed terminal", "full pipe")
PIPE_SIZE = 4096  #: bytes, the smallest pipe there is
#: Benches by the devices on them.
BENCHES = ("native", "native and zaber", "CAN")


class LiveBench:
    """An emulated bench with a quick stage near its references, served at real time by a thread of this process."""

    def __init__(self, *, seed: int, devices: str = "native") -> None:
        profile = load_profile("tvg43")
        stage = profile.stage
        near = {name: replace(getattr(stage, name), power_up_deg=8.0) for name in ("azimuth", "elevation")}
        stage = replace(stage, max_speed_deg_per_s=45.0, max_acceleration_deg_per_s2=45.0, **near)
        stage = replace(stage, stop_deceleration_deg_per_s2=450.0)  # at rest within 0.1 s of a command
        served = _served(replace(profile, stage=stage), devices, seed=seed, latitude=math.radians(50.429))
        self._served, self._stage = served, served.bench.plant_stage
        self.options = [f"--{name}={address}" for name, address in served.addresses.items()]  #: that name its devices
        self._stop = threading.Event()

    def __enter__(self) -> Self:
        """Switch it on."""
        self._wall = WallTime(time.monotonic)
        pace = Pace(self._served.bench, 1.0)
        self._thread = threading.Thread(target=server._run, args=(pace, self._wall, self._served, self._stop))
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        """Switch it off."""
        self._stop.set()
        self._thread.join()
        for connection in self._served.connections:
            connection.port.close()

    def stage_moves(self) -> bool:
        """Return whether an axis truly moves."""
        return self._stage.rest_since_us() > self._served.bench.now_us

    def at_rest_since(self) -> float:
        """Return since when both axes have been at rest, or when they will be, by the clock of `time.monotonic`."""
        return self._wall.origin + 1e-6 * self._stage.rest_since_us()


def _served(profile: Profile, devices: str, **world: Any) -> Served:  # noqa: ANN401  # what the emulator's World takes
    """Return the bench of a profile behind its ports."""
    if devices == "CAN":
        can_bench = CanBench(profile, **world)
        bus = BusConnection(can_bench, open_port(can_bench, "socketcand", LOOPBACK))
        return Served(can_bench, [bus], bus.addresses)
    gyro, stage = ("native", "native") if devices == "native" else devices.split(" and ")
    bench = SimBench(profile, gyro=gyro, stage=stage, **world)
    lines = [Connection(line, line, PtyPort()) for line in (bench.gyro, bench.stage)]
    addresses = [f"{kind}:{line.port.address}" for kind, line in zip((gyro, stage), lines, strict=True)]
    return Served(bench, lines, dict(zip(("gyro", "stage"), addresses, strict=True)))


class Host:
    """The program, running. What it says on its terminal is taken, if it has one, and left if it has a pipe."""

    def __init__(self, how: str, command: list[str]) -> None:
        self._how = how
        self._terminal: int | None = None
        command = ["env", "--default-signal", *command]  # whatever those who started these tests ignore
        if how == "closed terminal":
            self._terminal, theirs = pty.openpty()
            command = ["setsid", "--ctty", *command]
        else:
            self._pipe, theirs = os.pipe()
            if how == "full pipe":
                fcntl.fcntl(theirs, fcntl.F_SETPIPE_SZ, PIPE_SIZE)
                os.write(theirs, bytes(PIPE_SIZE))
        self._process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs)
        os.close(theirs)

    def go_on_until(self, condition: Callable[[], bool]) -> None:
        """Let it run until something has come about."""
        while not condition():
            assert self._process.poll() is None, "the program has ended before"
            self.go_on(0.02)

    def go_on(self, duration: float) -> None:
        """Let it run for so long, in s, or to its end."""
        end = time.monotonic() + duration
        while self._terminal is not None and (left := end - time.monotonic()) > 0:
            if select.select([self._terminal], [], [], left)[0] and not _taken(self._terminal):
                break
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(max(0.0, end - time.monotonic()))

    def interrupt(self) -> float:
        """Interrupt it; return the instant before."""
        instant = time.monotonic()
        if self._terminal is None:
            self.send(SIGNALS.get(self._how, signal.SIGINT))
        else:
            os.close(self._terminal)
            self._terminal = None
        return instant

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def said(self) -> str:
        """Return what it has said on its pipe and nobody has read."""
        return os.read(self._pipe, 1 << 16).decode()

    def wait(self, timeout: float) -> int:
        """Wait until it has ended, for `timeout` s at most; return its exit code."""
        return self._process.wait(timeout)

    def end(self) -> None:
        """End it if it has not ended."""
        self._process.kill()
        self._process.wait()
        for end in (self._terminal, None if self._how == "closed terminal" else self._pipe):
            if end is not None:
                os.close(end)


def _taken(terminal: int) -> bytes:
    """Return what was said on a terminal, nothing once whoever spoke there has ended."""
    try:
        return os.read(terminal, 4096)
    except OSError:
        return b""


@contextlib.contextmanager
def interruptible(how: str, command: list[str], folder: Path) -> Iterator[Host]:
    """Run the program with its records in a folder of `folder`, to be interrupted in one of INTERRUPTIONS."""
    host = Host(how, [*command, "--out", str(folder / "records")])
    try:
        yield host
    finally:
        host.end()
