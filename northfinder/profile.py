"""What is known of a gyro before it measures: its noise and its constants, in field units as on a data sheet."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path

import msgspec

from northfinder.errors import ConfigError
from northfinder.toml import decode_toml, read_toml


class NoiseTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Noise coefficients, named as in IEEE Std 952 and 1431."""

    angle_white_noise_dph_s: float = 0.0
    angle_random_walk_deg_per_sqrt_h: float = 0.0
    bias_instability_dph: float = 0.0
    rate_random_walk_dph_per_sqrt_h: float = 0.0
    rate_ramp_dph_per_h: float = 0.0

    def __post_init__(self) -> None:
        """Check that every coefficient can be one."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be zero or positive, not {value}")


class ErrorTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Standard deviations of what the data cannot show: they go into the uncertainty of every fix."""

    tilt_sd_arcsec: float = 0.0  #: of the measured tilt, a constant error either way
    stage_angle_sd_arcsec: float = 0.0  #: of either stage angle at a position, the same at each visit
    misalignment_sd_arcsec: float = 0.0  #: of the input axis against the stage, either way
    gyro_bias_sd_dph: float | None = None  #: of each gyro of a triad about zero, from turn-on to turn-on; None: unknown
    accelerometer_bias_sd_mg: float | None = None  #: of each accelerometer about zero, likewise

    def __post_init__(self) -> None:
        """Check that every standard deviation can be one."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be zero or positive, not {value}")
        if self.gyro_bias_sd_dph == 0.0:
            raise ValueError("gyro_bias_sd_dph must be positive, or left out where nothing is known of the biases")


class GyroProfile(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A gyro's data sheet on its stage: noise, terms a fix is corrected for, errors that nobody can correct."""

    name: str
    noise: NoiseTable
    acceleration_sensitive_drift_rate_dph_per_g: float | None = None  #: None if it is not known
    acceleration_sensitive_drift_rate_sd_dph_per_g: float = 0.0
    scale_factor: float | None = None
    scale_factor_sd: float = 0.0
    errors: ErrorTable = ErrorTable()


def built_in_profiles() -> list[str]:
    """Return the names of the profiles that come with the program."""
    folder = resources.files("northfinder").joinpath("profiles")
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def find_profile(name_or_file: str) -> GyroProfile:
    """Return the built-in profile of that name, else read the TOML file of that name. Raises ConfigError."""
    if name_or_file in built_in_profiles():
        entry = resources.files("northfinder").joinpath("profiles", f"{name_or_file}.toml")
        return decode_toml(entry.read_bytes(), GyroProfile, source=f"profile {name_or_file}")
    path = Path(name_or_file)
    if not path.exists():
        known = ", ".join(built_in_profiles())
        raise ConfigError(f"no gyro profile {name_or_file!r}: expected {known}, or a TOML file of a profile")
    return read_toml(path, GyroProfile)
