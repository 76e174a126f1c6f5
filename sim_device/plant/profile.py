"""What a bench is made of: gyro and stage with their errors, read from a TOML file in field units.

Profiles that come with the emulator lie beside this module in ``profiles``; a path to a file of one's own does as well.
A file of a gyro's noise alone, as ``northfinder allan`` saves it, makes a gyro with that noise on the bench of tvg43.
Every key is checked: an unknown one, a wrong type or a value out of range is a ValueError that names key and file.
"""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated

import msgspec

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Text16 = Annotated[str, msgspec.Meta(min_length=1, max_length=16, pattern="^[ -~]+$")]


class NoiseProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Noise coefficients, IEEE Std 952 names."""

    angle_white_noise_dph_s: NotNegative = 0.0  #: deg/h*s, sd q of the white angle: rate = (w[i+1] - w[i]) * rate
    angle_random_walk_deg_per_sqrt_h: NotNegative = 0.0
    bias_instability_dph: NotNegative = 0.0  #: B; the Allan deviation's floor is 0.664 B
    rate_random_walk_dph_per_sqrt_h: NotNegative = 0.0
    rate_ramp_dph_per_h: float = 0.0


class RecordingProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A real recording that stands in for the noise of every axis."""

    file: str  #: .npz or .npy, relative to the profile's own folder
    key: str = "rate_dph"  #: array inside an .npz
    sample_rate_hz: Positive
    dph_per_count: float = 1.0  #: scale of the array's numbers
    start: Annotated[int, msgspec.Meta(ge=0)] = 0  #: first sample used
    repeat: bool = False  #: begin again at its end, else too long a run is an error


class TemperatureProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Temperature of the gyro, and what it does to the bias."""

    ambient_c: float = 24.0
    warm_up_rise_c: float = 0.0  #: how much warmer than the ambient it gets
    warm_up_time_constant_s: Positive = 600.0
    reference_c: float = 24.0  #: temperature at which `bias_dph` holds
    bias_coefficient_dph_per_c: float = 0.0


class AccelerometerProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Three accelerometers along the gyro's axes."""

    bias_mg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity_random_walk_mg_per_sqrt_hz: NotNegative = 0.0


class GyroProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A gyro and its errors; a scalar holds for every axis."""

    model: Text16
    n_axes: int = 1
    sample_rate_hz: Positive
    range_dph: Positive
    resolution_dph: NotNegative = 0.0  #: of the gyro itself; the wire's is 2^-10 deg/h
    turn_on_time_s: NotNegative = 0.0  #: not ready before
    scale_factor_error: float = 0.0
    bias_dph: float = 0.0
    turn_on_bias_sd_dph: NotNegative = 0.0  #: drawn anew at each start
    acceleration_sensitive_drift_rate_dph_per_g: float = 0.0
    input_axis_misalignment_arcsec: list[tuple[float, float, float]] = []  #: rotation vector of each axis
    tilt_noise_arcsec: NotNegative = 0.0  #: sd of each reading of the tilt sensors
    accelerometers: AccelerometerProfile = AccelerometerProfile()
    noise: NoiseProfile = NoiseProfile()
    recording: RecordingProfile | None = None
    temperature: TemperatureProfile = TemperatureProfile()

    def __post_init__(self) -> None:
        if self.n_axes not in {1, 3}:
            raise ValueError(f"n_axes must be 1 or 3, got {self.n_axes}")
        if self.input_axis_misalignment_arcsec and len(self.input_axis_misalignment_arcsec) != self.n_axes:
            raise ValueError(f"input_axis_misalignment_arcsec must hold {self.n_axes} rotation vectors")


class AxisProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One axis of the stage and its errors. Soft limits lie within the switches, those within the mechanics."""

    limit_deg: Positive  #: widest soft limit, either side of the reference
    switch_deg: Positive  #: where the limit switches close
    mechanics_deg: Positive  #: where the axis hits its stop
    power_up_deg: NotNegative = 0.0  #: stands anywhere within this at power-up
    encoder_resolution_arcsec: NotNegative = 0.0
    positioning_error_arcsec: NotNegative = 0.0  #: rms over a turn, encoder against true angle
    repeatability_arcsec: NotNegative = 0.0  #: sd from one move to the next
    backlash_arcsec: NotNegative = 0.0

    def __post_init__(self) -> None:
        if not self.power_up_deg <= self.limit_deg < self.switch_deg < self.mechanics_deg:
            raise ValueError("must be power_up_deg <= limit_deg < switch_deg < mechanics_deg")


class StageProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A two-axis stage."""

    model: Text16
    max_speed_deg_per_s: Positive
    max_acceleration_deg_per_s2: Positive
    stop_deceleration_deg_per_s2: Positive  #: of STOP and faults
    cable_wrap_deg: Positive  #: azimuth, either side of the reference
    azimuth: AxisProfile
    elevation: AxisProfile


class Profile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole bench."""

    name: str
    description: str = ""
    gyro: GyroProfile
    stage: StageProfile


class IdentifiedProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the instrument knows of a gyro; standard deviations are its own business and are not used."""

    name: str
    noise: NoiseProfile
    acceleration_sensitive_drift_rate_dph_per_g: float = 0.0
    acceleration_sensitive_drift_rate_sd_dph_per_g: NotNegative = 0.0
    scale_factor: Positive | None = None
    scale_factor_sd: NotNegative = 0.0


def with_parked_stage(profile: Profile) -> Profile:
    """Return the bench with a stage that stands at zero when it is switched on."""
    stage = profile.stage
    axes = {name: msgspec.structs.replace(getattr(stage, name), power_up_deg=0.0) for name in ("azimuth", "elevation")}
    return msgspec.structs.replace(profile, stage=msgspec.structs.replace(stage, **axes))


def profile_names() -> list[str]:
    """Return the names of the profiles that come with the emulator."""
    folder = resources.files(__package__) / "profiles"
    return sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml"))


def load_profile(name_or_path: str | Path) -> Profile:
    """Return the profile of that name, or of the file at that path.

    Raises
    ------
    ValueError
        If there is no such profile, or one of its keys is unknown, missing or out of range.

    """
    if str(name_or_path) in profile_names():
        text = (resources.files(__package__) / "profiles" / f"{name_or_path}.toml").read_text(encoding="utf-8")
        return _parse(text, f"{name_or_path}.toml", Path())
    path = Path(name_or_path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        names = ", ".join(profile_names())
        raise ValueError(f"no profile {str(name_or_path)!r}: neither one of {names} nor a readable file") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file in UTF-8") from error
    return _parse(text, str(path), path.resolve().parent)


def _parse(text: str, origin: str, folder: Path) -> Profile:
    try:
        table = tomllib.loads(text)
        if "noise" in table and "gyro" not in table:
            return _on_tvg43_bench(msgspec.convert(table, IdentifiedProfile))
        profile = msgspec.convert(table, Profile)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ValueError(f"{origin}: {str(error).replace('Object contains unknown field', 'unknown key')}") from error
    recording = profile.gyro.recording
    if recording is None:
        return profile
    found = msgspec.structs.replace(recording, file=str(folder / recording.file))
    return msgspec.structs.replace(profile, gyro=msgspec.structs.replace(profile.gyro, recording=found))


def _on_tvg43_bench(identified: IdentifiedProfile) -> Profile:
    """Return the bench of tvg43 with a gyro whose identified errors take the place of its own."""
    bench = load_profile("tvg43")
    gyro = msgspec.structs.replace(
        bench.gyro,
        model="identified",
        noise=identified.noise,
        acceleration_sensitive_drift_rate_dph_per_g=identified.acceleration_sensitive_drift_rate_dph_per_g,
        scale_factor_error=0.0 if identified.scale_factor is None else identified.scale_factor - 1.0,
    )
    return msgspec.structs.replace(bench, name=identified.name, description="", gyro=gyro)
