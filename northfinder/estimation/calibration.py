"""Constants of an instrument from measurements where the truth is known (docs/method.md, section 9).

Two models explain why the vertical plane reads otherwise than the horizontal one. With the earth's horizontal and
vertical rate ``Omega cos lat`` and ``Omega sin lat``, the measured ``H = hypot(N, E)`` and ``V`` are

    acceleration-sensitive    H = s Omega cos lat,    V = s Omega sin lat + d_g
    ratio                     H = s Omega cos lat,    V = (s/k) Omega sin lat        k of [S2] (11), (12)

Both are linear, and both fit the data of one latitude alike; several latitudes tell them apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from northfinder.errors import EstimateError
from northfinder.estimation.angles import agreements, constrain
from northfinder.estimation.campaign import circular_mean, deviations
from northfinder.estimation.fix import Fix, Known
from northfinder.estimation.geometry import wrapped
from northfinder.estimation.least_squares import RESCALE_BELOW
from northfinder.estimation.quantiles import chi_square, chi_square_tail
from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]
Model = Literal["acceleration-sensitive", "ratio"]

#: The data support a model that makes them this many times more probable than the other one does.
ODDS = 20.0
#: A vertical rate below this sine of latitude says nothing of the ratio.
_LEVEL = 0.01
_LATITUDE_STEP = 0.01  # of the latitude's sd, for its derivative


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reading:
    """One measurement for calibration: nothing was taken as known when it was estimated."""

    rates: Array  #: (3,) N, E, V, rad/s, nothing taken off
    covariance: Array  #: (3, 3), of what differs from one measurement to the next
    common: Array  #: (3, 3), of what all measurements share: stage angles, tilt
    latitude: float  #: rad, the true one
    azimuth: float | None = None  #: rad, the true azimuth of the line that is to be measured


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelFit:
    """One of the two models, fitted: ``first`` is s; ``second`` is d_g in rad/s per g, or k."""

    first: float
    second: float
    covariance: Array  #: (2, 2)
    chi2: float
    dof: int

    @property
    def first_sd(self) -> float:
        """Standard deviation of `first`."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def second_sd(self) -> float:
        """Standard deviation of `second`."""
        return math.sqrt(self.covariance[1, 1])

    @property
    def correlation(self) -> float:
        """Correlation of the two."""
        return float(self.covariance[0, 1] / (self.first_sd * self.second_sd))

    @property
    def probability(self) -> float | None:
        """Probability of a chi square at least as large if the model is right, None without degrees of freedom."""
        return chi_square_tail(self.chi2, self.dof) if self.dof else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Constants:
    """What the measurements say of the instrument."""

    acceleration_sensitive: ModelFit
    ratio: ModelFit | None  #: None on the equator, where the vertical plane reads nothing
    supported: Model | None  #: which model the data support, None if they do not tell
    azimuth_offset: float | None  #: rad, measured less true azimuth
    azimuth_offset_sd: float | None


def calibrate(readings: Sequence[Reading], *, latitude_sd: float = 0.0, azimuth_sd: float = 0.0) -> Constants:
    """Return the constants that fit all `readings`.

    Parameters
    ----------
    readings : sequence of Reading
        At least one.
    latitude_sd, azimuth_sd : float
        Of the true values given, rad; the same error is meant wherever the same latitude is given.

    Raises
    ------
    EstimateError
        There is no reading, or one does not stand out of its noise.
    """
    if not readings:
        raise EstimateError("there is no measurement to calibrate from")
    drift = _fitted(readings, _by_drift, latitude_sd)
    ratio = None
    if max(abs(math.sin(reading.latitude)) for reading in readings) > _LEVEL:
        ratio = _as_ratio(_fitted(readings, _by_ratio, latitude_sd))
    offset, offset_sd = _azimuth_offset([reading for reading in readings if reading.azimuth is not None], azimuth_sd)
    return Constants(
        acceleration_sensitive=drift,
        ratio=ratio,
        supported=None if ratio is None else _supported(drift, ratio),
        azimuth_offset=offset,
        azimuth_offset_sd=offset_sd,
    )


def _by_drift(latitude: float) -> Array:
    return np.array([[EARTH_RATE * math.cos(latitude), 0.0], [EARTH_RATE * math.sin(latitude), 1.0]])


def _by_ratio(latitude: float) -> Array:
    return np.diag([EARTH_RATE * math.cos(latitude), EARTH_RATE * math.sin(latitude)])


def _planes(reading: Reading) -> tuple[Array, Array, Array]:
    """Return H and V, their covariance, and what of it is common to all readings."""
    north, east, vertical = reading.rates
    level = math.hypot(north, east)
    turn = np.array([[north / level, east / level, 0.0], [0.0, 0.0, 1.0]])
    return np.array([level, vertical]), turn @ reading.covariance @ turn.T, turn @ reading.common @ turn.T


def _fitted(readings: Sequence[Reading], design: Callable[[float], Array], latitude_sd: float) -> ModelFit:
    """Return the weighted least squares of one model over all readings."""
    planes = [_planes(reading) for reading in readings]
    latitudes = np.array([reading.latitude for reading in readings])
    whiten = linalg.block_diag(*(np.linalg.inv(np.linalg.cholesky(cov)) for _, cov, _ in planes))
    rows = whiten @ np.vstack([design(latitude) for latitude in latitudes])
    inverse = np.linalg.pinv(rows) @ whiten  # from H and V of all readings to the two constants
    measured = np.concatenate([each for each, _, _ in planes])
    found = inverse @ measured
    chi2, dof = float(np.sum((whiten @ measured - rows @ found) ** 2)), len(measured) - 2
    rescale = chi2 / dof if dof and chi2 > chi_square(RESCALE_BELOW, dof) else 1.0
    cov = rescale * np.linalg.inv(rows.T @ rows)
    for latitude in np.unique(latitudes):  # the same wrong entry for all readings there
        turned = _LATITUDE_STEP * latitude_sd
        moved = (design(latitude + turned) - design(latitude - turned)) @ found / (2.0 * _LATITUDE_STEP)
        by_entry = inverse @ np.outer(latitudes == latitude, moved).ravel()
        cov = cov + np.outer(by_entry, by_entry)
    summed = inverse.reshape(2, -1, 2).sum(axis=1)
    cov = cov + summed @ np.mean([common for _, _, common in planes], axis=0) @ summed.T
    return ModelFit(first=float(found[0]), second=float(found[1]), covariance=cov, chi2=chi2, dof=dof)


def _as_ratio(fit: ModelFit) -> ModelFit:
    """Return the fit of the two scale factors as (s, k): k is the horizontal one over the vertical one."""
    ratio = fit.first / fit.second
    turn = np.array([[1.0, 0.0], [1.0 / fit.second, -ratio / fit.second]])
    return replace(fit, second=ratio, covariance=turn @ fit.covariance @ turn.T)


def _supported(drift: ModelFit, ratio: ModelFit) -> Model | None:
    """Return the model that the likelihood ratio favours by more than ODDS, if the data fit it at all."""
    difference = ratio.chi2 - drift.chi2  # of twice the log likelihoods; the models have as many constants
    if abs(difference) < 2.0 * math.log(ODDS):
        return None
    return "acceleration-sensitive" if difference > 0.0 else "ratio"


def _azimuth_offset(readings: Sequence[Reading], azimuth_sd: float) -> tuple[float | None, float | None]:
    """Return the weighted mean of measured less true azimuth and its sd, widened if the scatter demands it."""
    if not readings:
        return None, None
    offsets, variances, common = [], [], []
    for reading in readings:
        north, east, _ = reading.rates
        by_rates = np.array([-east, north, 0.0]) / (north**2 + east**2)
        offsets.append(math.atan2(east, north) - (reading.azimuth or 0.0))
        variances.append(float(by_rates @ reading.covariance @ by_rates))
        common.append(float(by_rates @ reading.common @ by_rates))
    weights = 1.0 / np.array(variances)
    mean = circular_mean(offsets, weights)
    chi2, dof = float(np.sum(weights * deviations(offsets, mean) ** 2)), len(offsets) - 1
    rescale = chi2 / dof if dof and chi2 > chi_square(RESCALE_BELOW, dof) else 1.0
    variance = rescale / float(np.sum(weights)) + float(np.mean(common)) + azimuth_sd**2
    return mean, math.sqrt(variance)


def with_ratio(fix: Fix, known: Known, *, ratio: float, ratio_sd: float) -> Fix:
    """Return a fix as (12) has it: the vertical rate times k.

    Parameters
    ----------
    fix : Fix
        Estimated with nothing known of latitude, scale factor and acceleration-sensitive drift.
    known : Known
        Latitude and scale factor for the result.
    ratio, ratio_sd : float
        k and its standard deviation.
    """
    planes = np.diag([1.0, 1.0, ratio])
    rates = planes @ fix.rates
    cov = planes @ fix.rates_covariance @ planes.T
    cov[2, 2] += (ratio_sd * fix.rates[2]) ** 2
    found = constrain(rates, cov, known)
    return replace(
        fix,
        azimuth=wrapped(float(found.value[0])),
        azimuth_sd=found.sd(0),
        latitude=found.latitude,
        latitude_sd=found.sd(1),
        scale_factor=found.scale_factor,
        scale_factor_sd=found.sd(2),
        rates=rates,
        rates_covariance=cov,
        checks=(*fix.checks, *agreements(rates, cov, known, fix.sd_dof)),
    )
