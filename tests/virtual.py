"""A whole emulated bench in virtual time, driven by the real drivers, with or without faults."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from drivers.api import RateBlock
from drivers.native import NativeGyro, NativeStage
from drivers.transport.virtual import VirtualClock, VirtualLink
from northfinder.estimation import Fix
from northfinder.measurement import Measurement, Outcome, measure
from northfinder.record import DwellSpan
from northfinder.sequencer import Plan, Progress
from northfinder.solution import Assumptions
from sim_device.bench import SimBench
from sim_device.faults import FaultSpec, FaultyLine, link_faults, schedule


@dataclass
class VirtualBench:
    """The emulator and a clock; each open makes a driver on a new link."""

    bench: SimBench
    faults: tuple[str, ...] = ()
    clock: VirtualClock = field(default_factory=VirtualClock)
    _sessions: "count[int]" = field(default_factory=lambda: count(1000))

    def __post_init__(self) -> None:
        """Let the faults of devices and plant happen in their time."""
        self._specs = [FaultSpec.parse(fault) for fault in self.faults]
        schedule(self._specs, self.bench)

    def open_gyro(self) -> NativeGyro:
        """Return a driver of the emulated gyro."""
        return NativeGyro(self._link("gyro"), self.clock, draw_session=lambda: next(self._sessions))

    def open_stage(self) -> NativeStage:
        """Return a driver of the emulated stage."""
        return NativeStage(self._link("stage"), self.clock, draw_session=lambda: next(self._sessions))

    def _link(self, name: str) -> VirtualLink:
        line = FaultyLine(getattr(self.bench, name), link_faults(self._specs, name), seed=1)
        return VirtualLink(line, self.clock, name=f"virtual {name}")

    def measure(self, record: Path, plan: Plan, **changes: Any) -> Outcome:  # noqa: ANN401  # handed through
        """Run a whole measurement on the bench; `changes` replace fields of the assumptions."""
        measurement = Measurement(
            open_gyro=self.open_gyro,
            open_stage=self.open_stage,
            plan=plan,
            settle=0.5,
            assumptions=assume(**changes),
            record=record,
        )
        return measure(measurement, clock=self.clock, utc=self.clock.now, watcher=Unwatched())


def virtual_bench(
    profile: str = "tvg43", *, seed: int = 1, azimuth_deg: float = 33.0, latitude_deg: float = 50.429,
    faults: tuple[str, ...] = (),
) -> VirtualBench:  # fmt: skip
    """Return a bench whose input axis points to `azimuth_deg` at stage azimuth zero."""
    azimuth, latitude = math.radians(azimuth_deg), math.radians(latitude_deg)
    return VirtualBench(SimBench(profile, seed=seed, azimuth=azimuth, latitude=latitude), faults)


def assume(profile: str | None = "tvg43", **changes: Any) -> Assumptions:  # noqa: ANN401  # handed through
    """Return assumptions, those of the emulated gyro unless changed."""
    asked: dict[str, Any] = {"method": "generalised", "latitude_deg": None, "g_drift_dph": None} | changes
    return Assumptions.gather(profile=profile, **asked)


class Unwatched:
    """A watcher that looks away."""

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Show nothing."""


@dataclass
class Noted:
    """An observer that notes what it was told."""

    progress: list[Progress] = field(default_factory=list)
    dwells: list[tuple[DwellSpan, list[RateBlock]]] = field(default_factory=list)
    on_any: Callable[[Progress], None] = lambda progress: None  # noqa: ARG005  # nothing to do unless told

    def on_progress(self, progress: Progress) -> None:
        """Note it."""
        self.progress.append(progress)
        self.on_any(progress)

    def on_dwell(self, span: DwellSpan, blocks: list[RateBlock]) -> None:
        """Note it."""
        self.dwells.append((span, blocks))
