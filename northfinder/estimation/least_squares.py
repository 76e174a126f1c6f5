"""From interval means to a fix: ordinary or generalised least squares of the linear model (docs/method.md, 3).

Ordinary weights with the mean of each dwell are what the published method amounts to; generalised weights with short
means are the best linear unbiased estimate for the noise model given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from northfinder.errors import EstimateError
from northfinder.estimation import checks
from northfinder.estimation.angles import agreements, constrain, horizontal_only, require_horizontal
from northfinder.estimation.fix import Fix, Known
from northfinder.estimation.geometry import by_tilt, wrapped
from northfinder.estimation.linear import (
    Design,
    Drift,
    KnownBias,
    build_design,
    half_span,
    least_squares,
    per_dwell,
)
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.quantiles import chi_square
from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]
Weights = Literal["ordinary", "generalised"]

#: Residuals that a right noise model reaches less often than this put a factor on the standard deviations.
RESCALE_BELOW = 0.02
#: Positions whose elevations spread by this sine or more are there to measure the vertical earth rate.
MEASURES_VERTICAL = 0.05
_NO_VERTICAL = "no position turns the input axis up or down, so the vertical earth rate was not measured"
#: Opposite and repeated positions are compared among so many dwells, the first ones: their covariance is dense.
MAX_CLOSURES = 400
_UNKNOWN = Known()


def estimate(
    means: RateMeans,
    *,
    noise: NoiseModel | None = None,
    known: Known = _UNKNOWN,
    drift: Drift = "constant",
    weights: Weights = "ordinary",
    n_rejected: int = 0,
) -> Fix:
    """Estimate the azimuth of stage azimuth zero and the latitude.

    Parameters
    ----------
    means : RateMeans
        Means of each dwell, or shorter ones, of one axis or three.
    noise : NoiseModel, optional
        Of each axis. Without it the standard deviations come from the residuals.
    known : Known
        Latitude, scale factor and acceleration-sensitive drift rate where known, and the error of the tilt.
    drift : {"constant", "linear", "pairs"}
        How the bias runs; "pairs" gives every two successive dwells a bias of their own.
    weights : {"ordinary", "generalised"}
        Equal weights, or those of the noise model.
    n_rejected : int
        Means left out beforehand, for the report.

    Returns
    -------
    Fix
        Where the residuals, or those of the dwell means alone, are improbably large for the noise model, the standard
        deviations are multiplied by the Birge ratio, ``sqrt(chi2/dof)``, and `Fix.rescaled_by` says so. The dwell
        means show slow noise that the many short ones would outvote.

    Raises
    ------
    EstimateError
        The positions do not determine an azimuth, the horizontal earth rate is not distinguishable from zero, or
        without a noise model no residuals are left to judge the noise by.
    ValueError
        Generalised weights or known biases without a noise model, or a noise model that is all zero.
    """
    if weights == "generalised" and noise is None:
        raise ValueError("generalised weights need a noise model")
    if known.bias_sd is not None and noise is None:
        raise ValueError("known biases need a noise model to be weighed against")
    design = build_design(means, drift, bias_known=known.bias_sd is not None)
    fit, vertical = fit_best(design, noise, weights, known)
    nev, cov = _earth_rates(fit, known)
    horizontal = require_horizontal(nev, cov)
    constrained = constrain(nev, cov, known) if vertical else horizontal_only(nev, cov, known)
    bias, bias_sd, slope, slope_sd = _bias_terms(design, fit)
    residual = means.rate - (design.matrix @ fit.coefficients).reshape(means.n_axes, means.n).T
    return Fix(
        azimuth=wrapped(float(constrained.value[0])),
        azimuth_sd=constrained.sd(0),
        latitude=constrained.latitude,
        latitude_sd=None if constrained.latitude is None else constrained.sd(1),
        latitude_reason=_NO_VERTICAL if constrained.latitude is None else "",
        scale_factor=constrained.scale_factor,
        scale_factor_sd=None if constrained.scale_factor is None else constrained.sd(2),
        bias=bias,
        bias_sd=bias_sd,
        drift_rate=slope,
        drift_rate_sd=slope_sd,
        rates=nev,
        rates_covariance=cov,
        residuals=residual,
        n_means=means.n,
        dof=fit.dof,
        normalised_residual=fit.chi2 / fit.dof if noise is not None and fit.dof else None,
        rescaled_by=fit.rescaled_by,
        sd_dof=fit.sd_dof,
        n_rejected=n_rejected,
        checks=(horizontal, *_checks(means.with_rate(residual), fit, noise, nev, cov, known, vertical=vertical)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    coefficients: Array  # (p,): N, E, V with the acceleration-sensitive drift rate in it, bias terms
    covariance: Array  # (p, p)
    chi2: float  # of the whitened residuals; without a noise model of the plain ones, rad^2/s^2
    dof: int
    sd_dof: float
    rescaled_by: float
    tests: tuple[tuple[str, float, int], ...] = ()  # of the noise model: name, chi2 and dof of the residuals


def fit_best(design: Design, noise: NoiseModel | None, weights: Weights, known: Known) -> tuple[_Fit, bool]:
    """Return the fit, and whether V is measured: by design, or in spite of it better than it can be assumed."""
    if design.vertical >= MEASURES_VERTICAL:
        return _fit(design, noise, weights, None, known), True
    assumed = known.vertical_rate
    rows, columns = design.matrix.shape
    if design.vertical > 0.0 and (noise is not None or rows > columns):
        measured = _fit(design, noise, weights, None, known)
        if math.sqrt(measured.covariance[2, 2]) < assumed[1]:
            return measured, True
    return _fit(design, noise, weights, assumed, known), False


def _fit(
    design: Design, noise: NoiseModel | None, weights: Weights, vertical: tuple[float, float] | None, known: Known
) -> _Fit:
    """Solve the linear model; `vertical` is V and its sd where it is assumed, not measured."""
    rate = design.means.rate
    if noise is None:
        plain = least_squares(design.matrix, rate.T.ravel(), vertical)
        if plain.dof == 0:
            raise EstimateError(
                f"{design.means.n} means leave no residual to judge the noise by: give a noise model or measure more"
            )
        variance = plain.chi2 / plain.dof
        cov = variance * plain.inverse @ plain.inverse.T + plain.assumed
        return _Fit(plain.coefficients, cov, plain.chi2, plain.dof, float(plain.dof), 1.0)
    best = least_squares(*design.whitened(noise, rate), vertical, known_bias(design, known))
    tests = [("residuals", best.chi2, best.dof)]
    if (dwells := per_dwell(design)) is not None:
        slow = least_squares(*dwells.whitened(noise, dwells.means.rate), vertical, known_bias(dwells, known))
        tests.append(("residuals between dwells", slow.chi2, slow.dof))
    if weights == "generalised":
        chosen, cov = best, best.inverse @ best.inverse.T
    else:
        chosen = least_squares(design.matrix, rate.T.ravel(), vertical, known_bias(design, known, noise))
        cov = _propagate(chosen.inverse, noise.covariance(design.means))
    factor, sd_dof = max((_birge(chi2, dof) for _, chi2, dof in tests), key=lambda ratio: ratio[0])
    cov = factor**2 * cov + chosen.assumed
    return _Fit(chosen.coefficients, cov, best.chi2, best.dof, sd_dof, factor, tuple(tests))


def known_bias(design: Design, known: Known, noise: NoiseModel | None = None) -> KnownBias | None:
    """Return what is known of the biases, for rows that are whitened, or else have the variance of `noise`."""
    if known.bias_sd is None:
        return None
    row_sd = 1.0 if noise is None else math.sqrt(float(np.mean(np.diag(noise.covariance(design.means)))))
    return KnownBias(design.mean_biases, known.bias_sd, row_sd)


def _propagate(inverse: Array, covariance: Array) -> Array:
    """Return the covariance of the coefficients when the rows of each axis have `covariance`, axes independent."""
    n = len(covariance)
    blocks = (inverse[:, i : i + n] for i in range(0, inverse.shape[1], n))
    return np.asarray(sum(block @ covariance @ block.T for block in blocks))


def _birge(chi2: float, dof: int) -> tuple[float, float]:
    """Return the Birge ratio and its degrees of freedom if it is improbably large, else 1 and infinity."""
    if dof == 0 or chi2 <= chi_square(RESCALE_BELOW, dof):
        return 1.0, math.inf
    return math.sqrt(chi2 / dof), float(dof)


def _earth_rates(fit: _Fit, known: Known) -> tuple[Array, Array]:
    """Return N, E, V and their covariance, with the acceleration-sensitive drift and the tilt's error allowed for."""
    nev = fit.coefficients[:3] - np.array([0.0, 0.0, known.acceleration_sensitive_drift_rate])
    # The drift leans with the rotation axis, as the earth's rate does, so the fit before its removal is what turns.
    leaning = by_tilt(fit.coefficients[:3])
    cov = fit.covariance[:3, :3] + known.tilt_sd**2 * leaning @ leaning.T
    cov[2, 2] += known.acceleration_sensitive_drift_rate_sd**2
    return nev, cov


def _bias_terms(
    design: Design, fit: _Fit
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Return mean bias, its sd, slope and its sd of each axis; no slope unless the drift is linear."""
    n_bias = design.bias.shape[1]
    coefficients, cov = fit.coefficients[3:], fit.covariance[3:, 3:]
    level = design.mean_biases[:, 3:]
    bias, bias_sd = level @ coefficients, np.sqrt(np.diag(level @ cov @ level.T))
    if design.drift != "linear":
        return tuple(bias.tolist()), tuple(bias_sd.tolist()), (), ()
    span = half_span(design.means)
    slope, slope_sd = coefficients[n_bias - 1 :: n_bias] / span, np.sqrt(np.diag(cov)[n_bias - 1 :: n_bias]) / span
    return tuple(bias.tolist()), tuple(bias_sd.tolist()), tuple(slope.tolist()), tuple(slope_sd.tolist())


def _checks(
    residuals: RateMeans,
    fit: _Fit,
    noise: NoiseModel | None,
    nev: Array,
    covariance: Array,
    known: Known,
    *,
    vertical: bool,
) -> list[checks.Check]:
    """Return the checks beside that of the horizontal rate; `residuals` are the means of the fit's residuals."""
    dwells = residuals.per_dwell()
    dwells = dwells.select(np.arange(dwells.n) < MAX_CLOSURES)
    if noise is None:
        in_dwells = residuals.start < dwells.start[-1] + dwells.duration[-1]
        per_mean = np.bincount(np.searchsorted(dwells.start, residuals.start[in_dwells], side="right") - 1)
        dwell_cov = np.diag(fit.chi2 / fit.dof / per_mean)
    else:
        dwell_cov = noise.covariance(dwells)
    found = checks.closures(dwells, dwell_cov, fit.sd_dof if noise is None else math.inf)
    found += [checks.residuals(name, chi2, dof) for name, chi2, dof in fit.tests if dof]
    if vertical and known != _UNKNOWN:
        found += agreements(nev, covariance, known, fit.sd_dof)
    if not vertical:
        found += _horizontal_agreement(nev, covariance, known, fit.sd_dof)
    return found


def _horizontal_agreement(nev: Array, covariance: Array, known: Known, sd_dof: float) -> list[checks.Check]:
    """Return whether the horizontal earth rate is that of the known latitude, if the scale factor is known too."""
    if known.latitude is None or known.scale_factor is None:
        return []
    horizontal = math.hypot(nev[0], nev[1])
    direction = nev[:2] / horizontal
    per_scale = EARTH_RATE * math.cos(known.latitude)
    per_latitude = known.scale_factor * EARTH_RATE * math.sin(known.latitude)
    measured_sd = math.sqrt(max(float(direction @ covariance[:2, :2] @ direction), 0.0))
    sd = math.hypot(measured_sd, per_scale * known.scale_factor_sd, per_latitude * known.latitude_sd)
    return [checks.agreement("earth rate", horizontal - known.scale_factor * per_scale, sd, "rad/s", sd_dof)]
