"""From means, and what is known beforehand, to a fix; and the fix in the units of the field."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from northfinder.budget_report import budget_to_json
from northfinder.calibration import Calibration, RatioTable
from northfinder.errors import ConfigError
from northfinder.estimation import Check, Fix, Known, NoiseModel, RateMeans, estimate
from northfinder.estimation.budget import Declared, declared_variance, error_budget
from northfinder.estimation.calibration import with_ratio
from northfinder.estimation.disturbance import undisturbed
from northfinder.estimation.geometry import wrapped
from northfinder.estimation.least_squares import Weights
from northfinder.estimation.levelling import Levelling, level
from northfinder.estimation.propagation import gains
from northfinder.profile import GyroProfile, NoiseTable, find_profile
from northfinder.published import published_json
from northfinder.units import ARCSEC, DPH, MILLI_G

Method = Literal["generalised", "ordinary"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Assumptions:
    """How to estimate, and what is taken as known; kept in the record, so that the fix can be had again."""

    method: Method = "generalised"
    profile: GyroProfile | None = None
    latitude_deg: float | None = None  #: None to measure it
    latitude_sd_deg: float = 0.0
    g_drift_dph: float | None = None  #: in place of any other acceleration-sensitive drift rate, deg/h per g
    calibration: Calibration | None = None  #: in place of the profile's constants
    turn_sd_deg: float = 0.0  #: of a turn by hand

    @classmethod
    def gather(
        cls,
        *,
        method: Method,
        profile: str | None,
        latitude_deg: float | None,
        g_drift_dph: float | None,
        latitude_sd_deg: float = 0.0,
        calibration: Calibration | None = None,
        turn_sd_deg: float = 0.0,
    ) -> Assumptions:
        """Look up the profile and check that all goes together. Raises ConfigError."""
        if g_drift_dph is not None and not math.isfinite(g_drift_dph):
            raise ConfigError(f"the acceleration-sensitive drift rate must be a finite number, not {g_drift_dph}")
        if latitude_sd_deg and latitude_deg is None:
            raise ConfigError("a standard deviation of the latitude needs the latitude")
        return cls(
            method=method,
            profile=None if profile is None else find_profile(profile),
            latitude_deg=latitude_deg,
            latitude_sd_deg=latitude_sd_deg,
            g_drift_dph=g_drift_dph,
            calibration=calibration,
            turn_sd_deg=turn_sd_deg,
        )

    @property
    def ratio(self) -> RatioTable | None:
        """The calibrated ratio of the scale factors, None unless that model is to be applied."""
        calibration = self.calibration
        applied = calibration is not None and calibration.model == "ratio" and self.g_drift_dph is None
        return calibration.ratio if applied and calibration is not None else None

    def known(self) -> Known:
        """Return what the estimator may rely on, in SI."""
        profile, scale_factor = self._profile(), self._scale_factor()
        drift, drift_sd = self._drift_dph()
        return Known(
            latitude=None if self.latitude_deg is None else math.radians(self.latitude_deg),
            latitude_sd=math.radians(self.latitude_sd_deg),
            scale_factor=scale_factor[0],
            scale_factor_sd=scale_factor[1],
            acceleration_sensitive_drift_rate=drift * DPH,
            acceleration_sensitive_drift_rate_sd=drift_sd * DPH,
            tilt_sd=profile.errors.tilt_sd_arcsec * ARCSEC,
            bias_sd=None if profile.errors.gyro_bias_sd_dph is None else profile.errors.gyro_bias_sd_dph * DPH,
        )

    @property
    def accelerometer_bias_sd(self) -> float | None:
        """How far each accelerometer's bias may be from zero, m/s^2; None if that is not known."""
        bias_sd_mg = self._profile().errors.accelerometer_bias_sd_mg
        return None if bias_sd_mg is None else bias_sd_mg * MILLI_G

    def declared(self) -> Declared:
        """Return what is known of errors that the estimator does not see."""
        errors, calibration, ratio = self._profile().errors, self.calibration, self.ratio
        azimuth = None if calibration is None else calibration.azimuth
        drift = calibration is not None and ratio is None and self.g_drift_dph is None
        return Declared(
            stage_angle_sd=errors.stage_angle_sd_arcsec * ARCSEC,
            turn_sd=math.radians(self.turn_sd_deg),
            misalignment_sd=errors.misalignment_sd_arcsec * ARCSEC,
            azimuth_offset=0.0 if azimuth is None else math.radians(azimuth.offset_deg),
            azimuth_offset_sd=None if azimuth is None else math.radians(azimuth.offset_sd_deg),
            scale_drift_correlation=calibration.acceleration_sensitive.correlation if drift and calibration else 0.0,
            ratio=1.0 if ratio is None else ratio.ratio,
            ratio_sd=0.0 if ratio is None else ratio.ratio_sd,
        )

    def noise(self) -> NoiseModel | None:
        """Return the gyro's noise model, None without a profile."""
        if self.profile is None:
            return None
        table = self.profile.noise
        return NoiseModel.from_field_units(**{name: getattr(table, name) for name in table.__struct_fields__})

    @property
    def drift_rate_known(self) -> bool:
        """Whether anything tells the acceleration-sensitive drift rate; it is taken as zero otherwise."""
        told = self.g_drift_dph is not None or self.calibration is not None
        return told or self._profile().acceleration_sensitive_drift_rate_dph_per_g is not None

    def _profile(self) -> GyroProfile:
        return GyroProfile(name="", noise=NoiseTable()) if self.profile is None else self.profile

    def _scale_factor(self) -> tuple[float | None, float]:
        if self.calibration is not None and self.ratio is None:
            table = self.calibration.acceleration_sensitive
            return table.scale_factor, table.scale_factor_sd
        profile = self._profile()
        return profile.scale_factor, profile.scale_factor_sd

    def _drift_dph(self) -> tuple[float, float]:
        """Return the acceleration-sensitive drift rate and its sd: as given, as calibrated, or as in the profile."""
        if self.g_drift_dph is not None:
            return self.g_drift_dph, 0.0
        if self.ratio is not None:
            return 0.0, 0.0
        if self.calibration is not None:
            table = self.calibration.acceleration_sensitive
            return table.drift_rate_dph_per_g, table.drift_rate_sd_dph_per_g
        profile = self._profile()
        return (
            profile.acceleration_sensitive_drift_rate_dph_per_g or 0.0,
            profile.acceleration_sensitive_drift_rate_sd_dph_per_g,
        )


@dataclass(frozen=True, slots=True)
class Problem:
    """Means as the estimator is given them, and how they are weighted."""

    means: RateMeans
    noise: NoiseModel | None
    drift: Literal["constant", "linear"]
    weights: Weights
    n_rejected: int
    known: Known
    declared: Declared
    levelling: Levelling | None = None  #: None where tilt sensors, or nothing, tell the tilt

    @classmethod
    def of(cls, means: RateMeans, assumptions: Assumptions) -> Problem:
        """With a noise model short means weighted by it; without one dwells that count alike and a bias that drifts.

        Where accelerometers but no tilt sensors have measured, they tell the tilt.
        """
        noise, known, declared = assumptions.noise(), assumptions.known(), assumptions.declared()
        levelling = None
        if means.specific_force.any() and not means.tilt.any():
            levelling = level(means, bias_sd=assumptions.accelerometer_bias_sd)
            means = means.with_tilt(levelling.tilt)
            known = replace(known, tilt_sd=math.hypot(known.tilt_sd, levelling.tilt_sd))
            declared = replace(declared, azimuth_offset=declared.azimuth_offset - levelling.twist)
        if assumptions.method == "generalised" and noise is not None:
            keep = undisturbed(means)
            n_rejected = means.n - int(keep.sum())
            return cls(means.select(keep), noise, "constant", "generalised", n_rejected, known, declared, levelling)
        drift: Literal["constant", "linear"] = "linear" if noise is None else "constant"
        return cls(means.per_dwell(), noise, drift, "ordinary", 0, known, declared, levelling)

    def estimate(self, known: Known) -> Fix:
        """Return the fix of the estimator alone."""
        return estimate(
            self.means,
            noise=self.noise,
            known=known,
            drift=self.drift,
            weights=self.weights,
            n_rejected=self.n_rejected,
        )


def solve(means: RateMeans, assumptions: Assumptions) -> Fix:
    """Estimate the fix from means over short intervals, and apply the calibration. Raises EstimateError.

    With a noise model the short means are weighted by it; without one the dwells count alike, the bias may drift, and
    the standard deviations come from the residuals. Declared uncertainties are added to those of the estimate.
    """
    problem = Problem.of(means, assumptions)
    known, declared = problem.known, problem.declared
    fix = _planes_estimated(problem, known, declared)
    added = declared_variance(
        problem.means, fix, noise=problem.noise, known=known, drift=problem.drift, weights=problem.weights,
        declared=replace(declared, azimuth_offset=0.0),
    )  # fmt: skip
    return replace(
        fix,
        azimuth=wrapped(fix.azimuth - declared.azimuth_offset),
        azimuth_sd=math.sqrt(max(fix.azimuth_sd**2 + added[0], 0.0)),
        latitude_sd=None if fix.latitude_sd is None else math.sqrt(max(fix.latitude_sd**2 + added[1], 0.0)),
    )


def before_offset(fix: Fix, assumptions: Assumptions) -> Fix:
    """Return a fix of `solve` with the azimuth of stage azimuth zero again, the calibrated offset put back."""
    return replace(fix, azimuth=wrapped(fix.azimuth + assumptions.declared().azimuth_offset))


def _planes_estimated(problem: Problem, known: Known, declared: Declared) -> Fix:
    """Return the estimator's fix, with the calibrated ratio of the two planes if there is one."""
    if declared.ratio == 1.0 and declared.ratio_sd == 0.0:
        return problem.estimate(known)
    fix = problem.estimate(Known(tilt_sd=known.tilt_sd, bias_sd=known.bias_sd))
    if fix.latitude is None:  # no vertical plane was measured
        return problem.estimate(known)
    return with_ratio(fix, known, ratio=declared.ratio, ratio_sd=declared.ratio_sd)


def supplement(means: RateMeans, assumptions: Assumptions, fix: Fix) -> dict[str, Any]:
    """Return what a report says beside the fix that `solve` gave: its budget, published formulas, the calibration."""
    problem = Problem.of(means, assumptions)
    budget = error_budget(
        problem.means, fix, noise=problem.noise, known=problem.known, drift=problem.drift,
        weights=problem.weights, declared=problem.declared,
    )  # fmt: skip
    published = published_json(means, problem.noise, fix) | levelling_to_json(problem.levelling)
    said = {"budget": budget_to_json(budget), "notes": [*notes(assumptions, fix), *_level_notes(problem, assumptions)]}
    return said | published | calibration_to_json(assumptions)


def notes(assumptions: Assumptions, fix: Fix) -> list[str]:
    """Return in sentences what the operator ought to know of the assumptions behind a fix of `solve`."""
    known = assumptions.known()
    if assumptions.drift_rate_known or fix.latitude is None or known.latitude is not None:
        return []
    shift = abs(float(gains(fix, known, azimuth=fix.azimuth, vertical=True).rates[1, 2])) * DPH
    effect = f"each deg/h per g of it shifts the latitude by {math.degrees(shift):.2g} deg"
    return [f"the acceleration-sensitive drift rate is not known and taken as zero: {effect}"]


def _level_notes(problem: Problem, assumptions: Assumptions) -> list[str]:
    """Return in sentences what of the levelling the operator ought to know."""
    if problem.levelling is None or problem.levelling.n_attitudes > 1 or assumptions.accelerometer_bias_sd is not None:
        return []
    by_milli_g = math.degrees(MILLI_G / problem.levelling.specific_force)
    return [
        f"the accelerometers' biases are not known and taken as zero: each mg of them is {by_milli_g:.2g} deg of tilt"
    ]


def levelling_to_json(levelling: Levelling | None) -> dict[str, Any]:
    """Return the tilt that accelerometers have shown, nothing if it was not theirs to show; deg and mg."""
    if levelling is None:
        return {}
    x, y = (math.degrees(angle) for angle in levelling.tilt)
    bias, bias_sd = ([float(each) / MILLI_G for each in of] for of in (levelling.bias, levelling.bias_sd))
    return {
        "levelling": {
            "tilt_x_deg": x,
            "tilt_y_deg": y,
            "tilt_sd_deg": math.degrees(levelling.tilt_sd),
            "specific_force_m_s2": levelling.specific_force,
            "accelerometer_bias_mg": bias,
            "accelerometer_bias_sd_mg": bias_sd,
        }
    }


def calibration_to_json(assumptions: Assumptions) -> dict[str, Any]:
    """Return which calibration was applied and how, nothing if there was none."""
    calibration = assumptions.calibration
    if calibration is None:
        return {}
    model = "given drift rate" if assumptions.g_drift_dph is not None else calibration.model
    named = {"serial_number": calibration.serial_number, "date": str(calibration.date)}
    offset = None if calibration.azimuth is None else calibration.azimuth.offset_deg
    until = {"valid_until": str(calibration.valid_until), "model": model, "azimuth_offset_deg": offset}
    return {"calibration": named | until}


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
    figures = {name: float(getattr(check, name) * factor) for name in ("value", "sd", "limit")}
    return {
        "name": check.name,
        "passed": bool(check.passed),
        "decisive": check.decisive,
        **figures,
        "unit": unit,
        "sentence": check.sentence,
    }
