"""Serves an emulated bench, at any speed: ``python -m sim_device``.

On two pseudo-terminals or TCP ports, or on a CAN bus.

Prints one line of JSON with the addresses, then serves until it is told to stop.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import selectors
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sim_device.bench import Line, SimBench, World
from sim_device.can_bench import BITRATE, CanBench
from sim_device.can_server import BUSES, BusConnection, schedule_bus
from sim_device.can_server import open_port as open_bus_port
from sim_device.faults import Endpoint, FaultSpec, FaultyLine, LinkFaults, link_faults, schedule
from sim_device.instruments import GYROS, STAGES
from sim_device.pace import Pace, WallTime
from sim_device.plant.gyro import ARCSEC
from sim_device.ports import Connection, Port, PtyPort, TcpPort

LONGEST_WAIT_S = 0.05  #: between looks at whether to stop
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """What to serve, and how."""

    profile: str = ""  #: name, or path of a TOML file; the gyro's own if empty
    gyro: str = "native"  #: which instruments, see `sim_device.instruments`
    stage: str = "native"
    seed: int = 0
    azimuth_deg: float = 0.0  #: true azimuth of stage azimuth zero
    latitude_deg: float = 50.429
    tilt_arcsec: tuple[float, float] = (0.0, 0.0)
    speed: float = 1.0  #: times real time, inf for as fast as the host keeps up
    only: str = ""  #: "gyro" or "stage", both if empty; a gyro alone stands on a mount at azimuth and elevation zero
    tcp: str = ""  #: address to listen on, pseudo-terminals if empty
    bus: str = ""  #: "socketcand" or "slcan" for a CAN bus, serial lines if empty
    bitrate: int = BITRATE  #: of the CAN bus
    faults: tuple[str, ...] = ()  #: see `sim_device.faults`
    parent_death: bool = False  #: stop when standard input ends, as it does when the parent dies


@dataclass(frozen=True, slots=True)
class Served:
    """A bench behind its ports."""

    bench: World
    connections: Sequence[Connection | BusConnection]
    addresses: dict[str, str]  #: by device


def make_bench(options: ServeOptions) -> SimBench:
    """Return the bench on serial lines that the options describe; ValueError if they do not make sense."""
    return SimBench(options.profile, gyro=options.gyro, stage=options.stage, **_world(options))


def _world(options: ServeOptions) -> dict[str, Any]:
    """Return what the options say of the world; ValueError if it makes no sense."""
    if not -90 <= options.latitude_deg <= 90:
        raise ValueError(f"the latitude must be from -90 to 90 deg, got {options.latitude_deg:g}")
    if not all(map(math.isfinite, (options.azimuth_deg, *options.tilt_arcsec))):
        raise ValueError("azimuth and tilt must be finite numbers")
    if options.seed < 0:
        raise ValueError(f"the seed must not be negative, got {options.seed}")
    return {
        "seed": options.seed,
        "azimuth": math.radians(options.azimuth_deg),
        "latitude": math.radians(options.latitude_deg),
        "tilt": (options.tilt_arcsec[0] * ARCSEC, options.tilt_arcsec[1] * ARCSEC),
        "parked": options.only == "gyro",
    }


def serve(options: ServeOptions, stop: threading.Event | None = None) -> None:
    """Serve the bench until SIGTERM or SIGINT, until `stop` is set, or, if so asked, until standard input ends.

    Raises
    ------
    ValueError
        If the options do not make sense.

    """
    stop = stop or threading.Event()
    served = _open_bus(options) if options.bus else _open_lines(options)
    pace = Pace(served.bench, options.speed)
    if options.parent_death:
        threading.Thread(target=_watch_input, args=(stop,), daemon=True).start()
    try:
        with _stopped_by_signals(stop):
            _announce(options, served)
            _run(pace, WallTime(time.monotonic), served, stop)
    finally:
        for connection in served.connections:
            connection.port.close()


def _open_lines(options: ServeOptions) -> Served:
    bench = make_bench(options)
    specs = [FaultSpec.parse(text) for text in options.faults]
    schedule(specs, bench)
    lines = [line for line in (bench.gyro, bench.stage) if options.only in {"", line.name}]
    connections = [Connection(line, _endpoint(line, specs, options.seed), _open_port(options)) for line in lines]
    drivers = {"gyro": options.gyro, "stage": options.stage}
    addresses = {each.line.name: f"{drivers[each.line.name]}:{each.port.address}" for each in connections}
    return Served(bench, connections, addresses)


def _open_bus(options: ServeOptions) -> Served:
    if {options.gyro, options.stage} != {"native"}:
        raise ValueError(f"a CAN bus carries the native bench alone, not {options.gyro} and {options.stage}")
    bench = CanBench(options.profile or GYROS["native"].profile, bitrate=options.bitrate, **_world(options))
    bench.lines = tuple(seat for seat in bench.lines if options.only in {"", seat.name})
    schedule_bus([FaultSpec.parse(text) for text in options.faults], bench)
    connection = BusConnection(bench, open_bus_port(bench, options.bus, options.tcp or LOOPBACK))
    return Served(bench, [connection], connection.addresses)


def _run(pace: Pace, wall: WallTime, served: Served, stop: threading.Event) -> None:
    bench, connections = served.bench, served.connections
    with selectors.DefaultSelector() as selector:
        watched: list[int] = []
        while not stop.is_set():
            handles = [handle for connection in connections if connection.plugged for handle in connection.port.handles]
            if handles != watched:
                _watch(selector, handles)
                watched = handles
            selector.select(min(LONGEST_WAIT_S, pace.wait_us() * 1e-6))
            pace.advance(wall.now_us())
            for connection in connections:
                connection.take_in(bench.now_us)
            while not _bring_out(connections, bench.now_us) and _run_ahead(pace, connections):
                pass


def _run_ahead(pace: Pace, connections: Sequence[Connection | BusConnection]) -> bool:
    """Let the world run ahead; return whether anything happened.

    On a bus it goes on until a host must say that it has read something: the heartbeats up to then go out together.
    """
    happened = ahead = pace.run_ahead()
    while ahead and isinstance(connections[0], BusConnection):
        ahead = pace.run_ahead()
    return happened


def _bring_out(connections: Sequence[Connection | BusConnection], now_us: int) -> bool:
    return sum(connection.bring_out(now_us) for connection in connections) > 0


def _watch(selector: selectors.BaseSelector, handles: list[int]) -> None:
    for handle in list(selector.get_map()):
        selector.unregister(handle)
    for handle in handles:
        selector.register(handle, selectors.EVENT_READ)


def _endpoint(line: Line, specs: list[FaultSpec], seed: int) -> Endpoint:
    faults = link_faults(specs, line.name)
    return line if faults == LinkFaults() else FaultyLine(line, faults, seed)


def _open_port(options: ServeOptions) -> Port:
    if options.tcp:
        return TcpPort(options.tcp)
    try:
        return PtyPort()
    except (ImportError, AttributeError):
        sys.stderr.write("there are no pseudo-terminals on this system: serving over TCP instead\n")
        return TcpPort(LOOPBACK)


def _announce(options: ServeOptions, served: Served) -> None:
    facts = {
        "profile": options.profile or served.bench.profile.name,
        "seed": options.seed,
        "azimuth_deg": options.azimuth_deg,
        "latitude_deg": options.latitude_deg,
        "pid": os.getpid(),
    }
    sys.stdout.write(json.dumps({**served.addresses, **facts}) + "\n")
    sys.stdout.flush()


def _watch_input(stop: threading.Event) -> None:
    # Not through sys.stdin: a thread waiting inside its buffer holds up the end of the process by a second.
    while os.read(sys.stdin.fileno(), 4096):
        pass
    stop.set()


@contextmanager
def _stopped_by_signals(stop: threading.Event) -> Iterator[None]:
    """Set `stop` on SIGTERM or SIGINT, where this thread may say what signals do."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def parse_speed(text: str) -> float:
    """Return the speed as a number: ``max`` is inf."""
    return math.inf if text == "max" else float(text)


def _parse_tilt(text: str) -> tuple[float, float]:
    tilt_x, tilt_y = text.split(",")
    return float(tilt_x), float(tilt_y)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim_device", description="Emulate a gyro on a rotation stage.")
    add = parser.add_argument
    add("--profile", default="", help="profile's name, or the path of its TOML file; the gyro's own if not given")
    add("--gyro", choices=sorted(GYROS), default="native", help="which instrument the gyro is")
    add("--stage", choices=sorted(STAGES), default="native", help="which instrument the stage is")
    add("--seed", type=int, default=0)
    add("--azimuth", type=float, default=0.0, help="true azimuth of stage azimuth zero, deg")
    add("--latitude", type=float, default=50.429, help="deg, north positive")
    add("--tilt", type=_parse_tilt, default=(0.0, 0.0), metavar="X,Y", help="lean of the rotation axis, arcsec")
    add("--speed", type=parse_speed, default=1.0, metavar="X|max", help="times real time, at least 1")
    add("--only", choices=["gyro", "stage"], default="", help="serve this device alone; a gyro then stands at zero")
    add("--tcp", nargs="?", const=LOOPBACK, default="", metavar="HOST", help="TCP instead of pseudo-terminals")
    add("--bus", choices=BUSES, default="", help="a CAN bus instead of serial lines")
    add("--bitrate", type=int, default=BITRATE, help="of the CAN bus, bit/s")
    add("--fault", action="append", default=[], metavar="FAULT", help="such as gyro:drop=1e-4 or stage:e-stop@30+5")
    add("--parent-death", action="store_true", help="stop when standard input ends")
    given = parser.parse_args(arguments)
    options = ServeOptions(
        profile=given.profile,
        gyro=given.gyro,
        stage=given.stage,
        seed=given.seed,
        azimuth_deg=given.azimuth,
        latitude_deg=given.latitude,
        tilt_arcsec=given.tilt,
        speed=given.speed,
        only=given.only,
        tcp=given.tcp,
        bus=given.bus,
        bitrate=given.bitrate,
        faults=tuple(given.fault),
        parent_death=given.parent_death,
    )
    try:
        serve(options)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"{parser.prog}: {error}\n")
        return 2
    return 0
