"""The configuration of a bench: one TOML file, strictly checked, and what stands in it as frozen structs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from drivers.api import StageLimits
from northfinder.errors import ConfigError
from northfinder.toml import read_toml

#: What a driver may be told in a bench's file.
Option = bool | int | float | str | list[float]


class GyroTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[gyro]``: where the gyro is and which profile describes it."""

    address: str
    profile: str | None = None
    baudrate: int | None = None  #: the driver's default if not given
    options: dict[str, Option] = {}  #: what its driver takes beside, see the driver's page in ``docs``

    def driver_options(self) -> dict[str, Any]:
        """Return what the gyro's driver is told beside its address."""
        return dict(self.options) | _stated(baudrate=self.baudrate)


class DriveTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[stage.drive]``: how the drives of a CiA 402 stage are used; see `drivers.cia402.options.DriveOptions`."""

    azimuth_units_per_turn: float | None = None
    elevation_units_per_turn: float | None = None
    speed_units: float | None = None
    acceleration_units: float | None = None
    acceleration_deg_s2: float | None = None
    homing_method: int | None = None
    home_speed_deg_s: float | None = None
    home_creep_deg_s: float | None = None
    azimuth_home_offset_deg: float = 0.0
    elevation_home_offset_deg: float = 0.0
    quick_stop: int = 6


class StageTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[stage]``: where the stage is, and limits narrower than its own."""

    address: str
    baudrate: int | None = None  #: the driver's default if not given
    azimuth_min_deg: float = -math.inf
    azimuth_max_deg: float = math.inf
    elevation_min_deg: float = -math.inf
    elevation_max_deg: float = math.inf
    max_speed_deg_s: float = math.inf
    drive: DriveTable | None = None
    options: dict[str, Option] = {}  #: as in ``[gyro]``

    def driver_options(self) -> dict[str, Any]:
        """Return what the stage's driver is told beside address and limits. Raises ConfigError if it takes no such."""
        told = dict(self.options) | _stated(baudrate=self.baudrate)
        if self.drive is None:
            return told
        if not self.address.startswith("cia402-stage:"):
            raise ConfigError(f"[stage.drive] is for a cia402-stage, not for {self.address}")
        from drivers.cia402 import DriveOptions  # noqa: PLC0415  # heavy, and only these stages need it

        drive = self.drive
        try:
            options = DriveOptions(
                units_per_turn=(drive.azimuth_units_per_turn, drive.elevation_units_per_turn),
                speed_units=drive.speed_units,
                acceleration_units=drive.acceleration_units,
                acceleration=_radians(drive.acceleration_deg_s2),
                homing_method=drive.homing_method,
                home_speed=_radians(drive.home_speed_deg_s),
                home_creep=_radians(drive.home_creep_deg_s),
                home_offset=(
                    math.radians(drive.azimuth_home_offset_deg),
                    math.radians(drive.elevation_home_offset_deg),
                ),
                quick_stop=drive.quick_stop,
            )
        except ValueError as error:
            raise ConfigError(f"[stage.drive]: {error}") from None
        return told | {"drive": options}

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
    position: str | None = None  #: LAT,LON[,HEIGHT] in deg and m
    epsg: int | None = None  #: of the grid; None for the UTM zone


class Config(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A bench and a measurement on it."""

    gyro: GyroTable
    stage: StageTable | None = None  #: None where the gyro stands on none
    measurement: MeasurementTable = msgspec.field(default_factory=MeasurementTable)


def read_config(path: Path) -> Config:
    """Read a bench's configuration. Raises ConfigError naming the file, the key, what was found and expected."""
    return read_toml(path, Config)


def _radians(angle_deg: float | None) -> float | None:
    return None if angle_deg is None else math.radians(angle_deg)


def _stated(**options: object) -> dict[str, object]:
    """Return those options that are not None."""
    return {name: value for name, value in options.items() if value is not None}
