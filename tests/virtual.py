"""A whole emulated bench in virtual time, driven by the real drivers."""

import math
from dataclasses import dataclass, field
from itertools import count

from drivers.native import NativeGyro, NativeStage
from drivers.transport.virtual import VirtualClock, VirtualLink
from sim_device.bench import SimBench


@dataclass
class VirtualBench:
    """The emulator and a clock; each open makes a driver on a new link."""

    bench: SimBench
    clock: VirtualClock = field(default_factory=VirtualClock)
    sessions: count = field(default_factory=lambda: count(1000))  # type: ignore[type-arg]  # not generic in 3.11

    def open_gyro(self) -> NativeGyro:
        """Return a driver of the emulated gyro."""
        link = VirtualLink(self.bench.gyro, self.clock, name="virtual gyro")
        return NativeGyro(link, self.clock, draw_session=lambda: next(self.sessions))

    def open_stage(self) -> NativeStage:
        """Return a driver of the emulated stage."""
        link = VirtualLink(self.bench.stage, self.clock, name="virtual stage")
        return NativeStage(link, self.clock, draw_session=lambda: next(self.sessions))


def virtual_bench(
    profile: str = "tvg43", *, seed: int = 1, azimuth_deg: float = 33.0, latitude_deg: float = 50.429
) -> VirtualBench:
    """Return a bench whose input axis points to `azimuth_deg` at stage azimuth zero."""
    azimuth, latitude = math.radians(azimuth_deg), math.radians(latitude_deg)
    return VirtualBench(SimBench(profile, seed=seed, azimuth=azimuth, latitude=latitude))
