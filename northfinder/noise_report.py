"""Identified noise in the units of a data sheet: as JSON, and as a gyro profile that `find` and the emulator take."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from northfinder.errors import RecordError
from northfinder.estimation.allan import AllanCurve
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.noise_identification import Coefficient, Identification
from northfinder.rate_files import RateSeries
from northfinder.text import printable
from northfinder.units import DPH

#: Each coefficient's key in a profile's ``[noise]`` table, and its unit for people.
FIELDS = {
    "angle_white_noise": ("angle_white_noise_dph_s", "deg/h s"),
    "angle_random_walk": ("angle_random_walk_deg_per_sqrt_h", "deg/√h"),
    "bias_instability": ("bias_instability_dph", "deg/h"),
    "rate_random_walk": ("rate_random_walk_dph_per_sqrt_h", "deg/h/√h"),
    "rate_ramp": ("rate_ramp_dph_per_h", "deg/h/h"),
}
_SI = {name: getattr(NoiseModel.from_field_units(**{key: 1.0}), name) for name, (key, _) in FIELDS.items()}


def in_field_units(coefficient: Coefficient) -> dict[str, float | None]:
    """Return value, sd and upper bound of a coefficient in the unit of `FIELDS`."""
    unit = _SI[coefficient.name]
    values = {"value": coefficient.value, "sd": coefficient.sd, "upper_bound": coefficient.upper_bound}
    return {name: None if value is None else value / unit for name, value in values.items()}


def noise_json(series: RateSeries, identified: Identification, curve: AllanCurve) -> dict[str, Any]:
    """Return everything as plain data."""
    return {
        "n_samples": series.rate.size,
        "sample_rate_hz": series.sample_rate,
        "duration_s": series.duration,
        "mean_rate_dph": float(series.rate.mean()) / DPH,
        "notes": list(series.notes),
        "coefficients": {
            FIELDS[each.name][0]: in_field_units(each) | {"observable": each.observable}
            for each in identified.coefficients
        },
        "model_error": identified.model_error,
        "allan": {
            "tau_s": curve.tau.tolist(),
            "deviation_dph": (curve.deviation / DPH).tolist(),
            "low_dph": (curve.low / DPH).tolist(),
            "high_dph": (curve.high / DPH).tolist(),
            "degrees_of_freedom": curve.edf.tolist(),
            "confidence": curve.confidence,
            "model_dph": (identified.noise.allan_deviation(curve.tau) / DPH).tolist(),
        },
    }


def decades(curve: AllanCurve) -> list[int]:
    """Return the indices of the averaging times nearest to 0.01, 0.1, 1, 10, ... s within the curve."""
    exponents = range(math.ceil(math.log10(curve.tau[0]) - 0.01), math.floor(math.log10(curve.tau[-1]) + 0.01) + 1)
    return [int(np.argmin(np.abs(np.log10(curve.tau) - exponent))) for exponent in exponents]


def save_profile(path: Path, name: str, series: RateSeries, identified: Identification) -> None:
    """Write a gyro profile of the identified noise; nothing else is known of the gyro.

    Raises RecordError if the file exists already, or cannot be written.
    """
    lines = [
        f"# Noise identified from {series.duration:.0f} s at {series.sample_rate:g} Hz.",
        f"name = {json.dumps(printable(name))}",
        "# Not known: acceleration_sensitive_drift_rate_dph_per_g, scale_factor.",
        "",
        "[noise]",
    ]
    for each in identified.coefficients:
        values = in_field_units(each)
        sd, bound = values["sd"], values["upper_bound"]
        comment = f"sd {sd:.2g}" if sd is not None else f"not observable, at most {bound:.2g}"
        lines.append(f"{FIELDS[each.name][0]} = {values['value']:.6g}  # {comment}")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(lines) + "\n")
    except FileExistsError:
        raise RecordError(f"the profile {path} exists already, and is not overwritten") from None
    except OSError as error:
        raise RecordError(f"the profile {path} cannot be written: {error.strerror}") from None
