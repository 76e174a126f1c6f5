"""From means, and what is known beforehand, to a fix; and the fix in the units of the field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from northfinder.errors import ConfigError
from northfinder.estimation import Check, Fix, Known, NoiseModel, RateMeans, estimate
from northfinder.estimation.disturbance import undisturbed
from northfinder.profile import GyroProfile, find_profile
from northfinder.units import DPH

Method = Literal["generalised", "ordinary"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Assumptions:
    """How to estimate, and what is taken as known; kept in the record, so that the fix can be had again."""

    method: Method = "generalised"
    profile: GyroProfile | None = None
    latitude_deg: float | None = None  #: None to measure it
    g_drift_dph: float | None = None  #: in place of the profile's acceleration-sensitive drift rate, deg/h per g

    @classmethod
    def gather(
        cls, *, method: Method, profile: str | None, latitude_deg: float | None, g_drift_dph: float | None
    ) -> Assumptions:
        """Look up the profile and check that all goes together. Raises ConfigError."""
        if g_drift_dph is not None and not math.isfinite(g_drift_dph):
            raise ConfigError(f"the acceleration-sensitive drift rate must be a finite number, not {g_drift_dph}")
        found = None if profile is None else find_profile(profile)
        return cls(method=method, profile=found, latitude_deg=latitude_deg, g_drift_dph=g_drift_dph)

    def known(self) -> Known:
        """Return what the estimator may rely on, in SI."""
        profile = self.profile
        drift, drift_sd = 0.0, 0.0
        if profile is not None:
            drift = profile.acceleration_sensitive_drift_rate_dph_per_g
            drift_sd = profile.acceleration_sensitive_drift_rate_sd_dph_per_g
        if self.g_drift_dph is not None:
            drift, drift_sd = self.g_drift_dph, 0.0
        return Known(
            latitude=None if self.latitude_deg is None else math.radians(self.latitude_deg),
            scale_factor=None if profile is None else profile.scale_factor,
            scale_factor_sd=0.0 if profile is None else profile.scale_factor_sd,
            acceleration_sensitive_drift_rate=drift * DPH,
            acceleration_sensitive_drift_rate_sd=drift_sd * DPH,
        )

    def noise(self) -> NoiseModel | None:
        """Return the gyro's noise model, None without a profile."""
        if self.profile is None:
            return None
        table = self.profile.noise
        return NoiseModel.from_field_units(**{name: getattr(table, name) for name in table.__struct_fields__})


def solve(means: RateMeans, assumptions: Assumptions) -> Fix:
    """Estimate the fix from means over short intervals. Raises EstimateError.

    With a noise model the short means are weighted by it; without one the dwells count alike, the bias may drift, and
    the standard deviations come from the residuals.
    """
    noise, known = assumptions.noise(), assumptions.known()
    if assumptions.method == "generalised" and noise is not None:
        keep = undisturbed(means)
        n_rejected = means.n - int(keep.sum())
        return estimate(means.select(keep), noise=noise, known=known, weights="generalised", n_rejected=n_rejected)
    drift: Literal["constant", "linear"] = "linear" if noise is None else "constant"
    return estimate(means.per_dwell(), noise=noise, known=known, drift=drift)


def fix_to_json(fix: Fix) -> dict[str, Any]:
    """Return the fix as plain data: angles in deg, rates in deg/h."""
    return {
        "azimuth_deg": math.degrees(fix.azimuth),
        "azimuth_sd_deg": math.degrees(fix.azimuth_sd),
        "latitude_deg": _degrees(fix.latitude),
        "latitude_sd_deg": _degrees(fix.latitude_sd),
        "latitude_reason": fix.latitude_reason,
        "bias_dph": fix.bias[0] / DPH if len(fix.bias) == 1 else [bias / DPH for bias in fix.bias],
        "scale_factor": fix.scale_factor,
        "scale_factor_sd": fix.scale_factor_sd,
        "n_rejected": fix.n_rejected,
        "normalised_residual": fix.normalised_residual,
        "rescaled_by": fix.rescaled_by,
        "trustworthy": fix.trustworthy,
        "checks": [_check_to_json(check) for check in fix.checks],
    }


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)


def _check_to_json(check: Check) -> dict[str, object]:
    factor, unit = {"rad/s": (1 / DPH, "deg/h"), "rad": (math.degrees(1.0), "deg")}.get(check.unit, (1.0, ""))
    figures = {name: getattr(check, name) * factor for name in ("value", "sd", "limit")}
    return {
        "name": check.name,
        "passed": check.passed,
        "decisive": check.decisive,
        **figures,
        "unit": unit,
        "sentence": check.sentence,
    }
