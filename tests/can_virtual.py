"""The emulated bench on a CAN bus in virtual time, driven by the real drivers, with or without faults."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import radians
from pathlib import Path
from typing import Any

from virtual import Unwatched, assume

from drivers.api import RateBlock, StageLimits, StageMode, StageState
from drivers.canopen_gyro import CanopenGyro
from drivers.canopen_gyro.gyro import IDENTIFIERS as GYRO_IDENTIFIERS
from drivers.cia402 import Cia402Stage, DriveOptions
from drivers.cia402.stage import IDENTIFIERS as STAGE_IDENTIFIERS
from drivers.transport.virtual import VirtualClock
from drivers.transport.virtual_bus import FrameDevice, VirtualBus, VirtualFrameLink
from northfinder.cyclogram import Cyclogram
from northfinder.measurement import Measurement, Outcome, measure
from sim_device.can_bench import AZIMUTH_ID, ELEVATION_ID, GYRO_ID, CanBench
from sim_device.can_server import schedule_bus
from sim_device.faults import FaultSpec

Fate = Callable[[int, bytes], list[tuple[int, bytes]]]


def pass_on(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
    """Leave a frame as it is."""
    return [(identifier, data)]


class WireTap:
    """The bench's wire as a device of a `VirtualBus`; keeps all frames, and decides what becomes of each."""

    def __init__(self, bench: CanBench) -> None:
        self.bench = bench
        self.to_bench: Fate = pass_on
        self.to_host: Fate = pass_on
        self.said: list[tuple[int, int, bytes]] = []  # by the nodes: time in us, identifier, data
        self.asked: list[tuple[int, int, bytes]] = []  # by the host
        self._tap = bench.wire.tap()

    def feed(self, identifier: int, data: bytes, now_us: int) -> None:
        """Carry a host's frame."""
        self._check()
        self.asked.append((now_us, identifier, data))
        for frame in self.to_bench(identifier, data):
            self._tap.send(*frame, now_us)

    def poll(self, now_us: int) -> list[tuple[int, bytes]]:
        """Carry the nodes' frames."""
        self.bench.advance_to(now_us)
        self._check()
        frames = []
        while self._tap.waiting:
            at_us, identifier, data = self._tap.waiting.popleft()
            self.said.append((at_us, identifier, data))
            frames += self.to_host(identifier, data)
        return frames

    def next_due_us(self) -> int | None:
        """Return when something happens on the bench."""
        self._check()
        return self.bench.now_us if self._tap.waiting else self.bench.next_due_us()

    def _check(self) -> None:
        if self.bench.wire.unplugged:
            raise ConnectionResetError("the adapter has been unplugged")


@dataclass
class CanVirtualBench:
    """The emulator, a clock and a bus; each open makes a driver on a new link."""

    bench: CanBench
    faults: tuple[str, ...] = ()
    others: tuple[FrameDevice, ...] = ()  #: strangers on the bus
    limits: StageLimits | None = None
    drive: DriveOptions | None = None
    clock: VirtualClock = field(default_factory=VirtualClock)

    def __post_init__(self) -> None:
        """Let the faults happen in their time."""
        schedule_bus([FaultSpec.parse(fault) for fault in self.faults], self.bench)
        self.tap = WireTap(self.bench)
        self.bus = VirtualBus([self.tap, *self.others], self.clock, name="virtual:bench")

    def link(self, identifiers: tuple[int, ...], node: int) -> VirtualFrameLink:
        """Return a link that gets the frames of a node."""
        return self.bus.link(accept=[base + node for base in identifiers])

    def open_gyro(self) -> CanopenGyro:
        """Return a driver of the emulated gyro."""
        return CanopenGyro(self.link(GYRO_IDENTIFIERS, GYRO_ID), self.clock, GYRO_ID)

    def open_stage(self) -> Cia402Stage:
        """Return a driver of the emulated stage."""
        nodes = (AZIMUTH_ID, ELEVATION_ID)
        links = [self.link(STAGE_IDENTIFIERS, node) for node in nodes]
        return Cia402Stage(links, self.clock, nodes, limits=self.limits, options=self.drive)

    def measure(self, record: Path, plan: Cyclogram, **changes: Any) -> Outcome:  # noqa: ANN401  # handed through
        """Run a whole measurement; `changes` replace fields of the assumptions."""
        measurement = Measurement(
            open_gyro=self.open_gyro,
            open_stage=self.open_stage,
            plan=plan,
            settle=0.5,
            assumptions=assume(**changes),
            record=record,
        )
        return measure(measurement, clock=self.clock, utc=self.clock.now, watcher=Unwatched())

    def homed(self) -> Cia402Stage:
        """Return a stage that is connected and homed."""
        stage = self.open_stage()
        stage.connect()
        stage.home()
        self.serve(stage, lambda state: state.mode is StageMode.IDLE)
        return stage

    def serve(self, stage: Cia402Stage, done: Callable[[StageState], bool], *, timeout: float = 120.0) -> StageState:
        """Serve a stage until `done`."""
        deadline = self.clock.now() + timeout
        while not done(state := stage.state()):
            assert self.clock.now() < deadline, f"still {state}"
            self.clock.wait(self.clock.now() + 0.05)
        return state

    def stream(self, gyro: CanopenGyro, duration: float) -> list[RateBlock]:
        """Read a gyro for a while."""
        end = self.clock.now() + duration
        blocks = gyro.read()
        while self.clock.now() < end:
            self.clock.wait(min(end, self.clock.now() + 0.05))
            blocks += gyro.read()
        return blocks


def can_bench(
    profile: str = "tvg43",
    *,
    seed: int = 1,
    azimuth_deg: float = 33.0,
    latitude_deg: float = 50.429,
    **options: Any,  # noqa: ANN401  # handed through
) -> CanVirtualBench:
    """Return a bench whose input axis points to `azimuth_deg` at stage azimuth zero."""
    world = CanBench(profile, seed=seed, azimuth=radians(azimuth_deg), latitude=radians(latitude_deg))
    return CanVirtualBench(world, **options)
