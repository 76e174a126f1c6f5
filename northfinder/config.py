"""The configuration of a bench: one TOML file, strictly checked, and what stands in it as frozen structs."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec

from drivers.api import StageLimits
from northfinder.toml import read_toml


class GyroTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[gyro]``: where the gyro is and which profile describes it."""

    address: str
    profile: str | None = None
    baudrate: int = 921600


class StageTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[stage]``: where the stage is, and limits narrower than its own."""

    address: str
    baudrate: int = 921600
    azimuth_min_deg: float = -math.inf
    azimuth_max_deg: float = math.inf
    elevation_min_deg: float = -math.inf
    elevation_max_deg: float = math.inf
    max_speed_deg_s: float = math.inf

    def limits(self) -> StageLimits:
        """Return the limits in rad; infinite where the device's own are to hold."""
        return StageLimits(
            azimuth_min=math.radians(self.azimuth_min_deg),
            azimuth_max=math.radians(self.azimuth_max_deg),
            elevation_min=math.radians(self.elevation_min_deg),
            elevation_max=math.radians(self.elevation_max_deg),
            max_speed=math.radians(self.max_speed_deg_s),
        )


class MeasurementTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[measurement]``: what to do with them."""

    plan: str | None = None
    dwell_s: float | None = None
    time_s: float | None = None
    until_sd_deg: float | None = None
    azimuth_deg: float | None = None
    settle_s: float = 0.5
    latitude_deg: float | None = None


class Config(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A bench and a measurement on it."""

    gyro: GyroTable
    stage: StageTable
    measurement: MeasurementTable = msgspec.field(default_factory=MeasurementTable)


def read_config(path: Path) -> Config:
    """Read a bench's configuration. Raises ConfigError naming the file, the key, what was found and expected."""
    return read_toml(path, Config)
