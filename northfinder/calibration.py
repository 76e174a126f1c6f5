"""The calibration of an instrument: a TOML file made by ``calibrate`` and applied by ``find`` and ``solve``.

It belongs to one gyro, by serial number, and is valid for a time.
"""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, cast

import msgspec

from drivers.api import DeviceIdentity, Gyro
from northfinder.errors import ConfigError, RecordError
from northfinder.toml import read_toml

Model = Literal["acceleration-sensitive", "ratio"]


class DriftTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[acceleration_sensitive]``: one scale factor, and a drift rate that gravity along the input axis brings."""

    scale_factor: float
    scale_factor_sd: float
    drift_rate_dph_per_g: float
    drift_rate_sd_dph_per_g: float
    correlation: float  #: of the two
    chi2: float
    dof: int


class RatioTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[ratio]``: two scale factors, the horizontal one k times the vertical one."""

    scale_factor: float  #: horizontal
    scale_factor_sd: float
    ratio: float  #: k
    ratio_sd: float
    chi2: float
    dof: int


class AzimuthTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[azimuth]``: what to take off the measured azimuth to have that of the mark."""

    offset_deg: float
    offset_sd_deg: float


class Calibration(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """All of the file."""

    serial_number: str  #: of the gyro
    gyro_model: str = ""
    date: dt.date  #: of the last measurement it rests on
    valid_until: dt.date
    n_records: int
    latitudes_deg: list[float]
    temperature_min_c: float | None = None
    temperature_max_c: float | None = None
    model: Model = "acceleration-sensitive"  #: which of the two is applied
    supported: Model | None = None  #: which of the two the data support
    acceleration_sensitive: DriftTable
    ratio: RatioTable | None = None
    azimuth: AzimuthTable | None = None

    def __post_init__(self) -> None:
        """Check what would make it useless."""
        if self.model == "ratio" and self.ratio is None:
            raise ValueError("the model is 'ratio', and there is no table [ratio]")
        if self.valid_until < self.date:
            raise ValueError(f"valid_until {self.valid_until} lies before the date {self.date}")

    def check(self, identity: DeviceIdentity | None, today: dt.date) -> None:
        """Refuse to serve another gyro or another time. Raises ConfigError."""
        if not self.date <= today <= self.valid_until:
            raise ConfigError(
                f"the calibration of gyro {self.serial_number} is valid from {self.date} to {self.valid_until}, "
                f"not on {today}"
            )
        if identity is not None and identity.serial_number != self.serial_number:
            raise ConfigError(
                f"the calibration belongs to the gyro with serial number {self.serial_number!r}, "
                f"and this one has {identity.serial_number!r}"
            )


def read_calibration(path: Path) -> Calibration:
    """Read the file of a calibration. Raises ConfigError naming the file, the key, what was found and expected."""
    return read_toml(path, Calibration)


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write `calibration` to a new file. Raises RecordError if it exists already or cannot be written."""
    tables: dict[str, Any] = msgspec.to_builtins(calibration, builtin_types=(dt.date,))
    plain = [_entry(key, value) for key, value in tables.items() if not isinstance(value, dict)]
    nested = [
        line
        for key, table in tables.items()
        if isinstance(table, dict)
        for line in ["", f"[{key}]", *(_entry(name, value) for name, value in table.items())]
    ]
    lines = ["# Calibration of a north-finder's gyro; northfinder find --calibration applies it.", *plain, *nested]
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(line for line in lines if line is not None) + "\n")
    except FileExistsError:
        raise RecordError(f"{path} exists already, and a calibration is never overwritten") from None
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {error.strerror}") from None


def _entry(key: str, value: object) -> str | None:
    """Return one line of TOML, None for what is not there: the strings, numbers and lists of JSON are those of TOML."""
    if value is None:
        return None
    return f"{key} = {value if isinstance(value, dt.date) else json.dumps(value)}"


class _Checked:
    """A gyro that is turned away at its first words unless it is the right one."""

    def __init__(self, gyro: Gyro, check: Callable[[DeviceIdentity], None]) -> None:
        self._gyro = gyro
        self._check = check

    def connect(self) -> DeviceIdentity:
        """Open a session with the right gyro. Raises what `check` raises."""
        identity = self._gyro.connect()
        self._check(identity)
        return identity

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # hands through whatever a gyro has
        return getattr(self._gyro, name)


def checked(gyro: Gyro, calibration: Calibration | None, today: dt.date) -> Gyro:
    """Return `gyro`, such that its `connect` raises ConfigError if the calibration is not for it."""
    if calibration is None:
        return gyro
    return cast("Gyro", _Checked(gyro, lambda identity: calibration.check(identity, today)))
