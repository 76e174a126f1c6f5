"""Overlapping Allan deviation of a rate with its confidence band (IEEE Std 952, annex C; docs/method.md, section 6).

The estimate at an averaging time is a mean of squares of correlated Gaussian second differences of the angle. With
``c(l)`` the covariance of two of them `l` samples apart, M of them have the equivalent degrees of freedom

    edf = 2 E^2/Var = M^2 c(0)^2 / sum_l (M - |l|) c(l)^2

(Percival and Walden, Wavelet Methods for Time Series Analysis, 2000, section 8.3), and ``edf * estimate/expectation``
is nearly chi-square distributed. ``c`` follows from the gyro's noise model, so that no averaging time has to be
assigned a single kind of noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from northfinder.errors import EstimateError
from northfinder.estimation.noise import NoiseModel

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Averaging factors to the tenfold averaging time.
PER_DECADE = 10
_LAGS_PER_FACTOR = 64  # grid on which the covariance of the second differences is summed


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AllanCurve:
    """Allan deviation against averaging time; arrays of shape (n,)."""

    tau: Array  #: averaging time, s
    deviation: Array  #: rad/s
    low: Array  #: lower end of the confidence band, rad/s
    high: Array  #: its upper end, rad/s
    edf: Array  #: equivalent degrees of freedom
    confidence: float  #: probability that the band holds the expectation


def averaging_factors(n_samples: int, *, per_decade: int = PER_DECADE) -> Integers:
    """Return whole numbers from 1 to at most a third of `n_samples`, evenly spaced on a logarithmic scale."""
    longest = n_samples // 3
    if longest < 1:
        raise EstimateError(f"{n_samples} samples give no Allan deviation: expected 3 or more")
    n = math.floor(per_decade * math.log10(longest)) + 1
    return np.unique(np.round(10.0 ** (np.arange(n) / per_decade)).astype(np.int64))


def overlapping_allan_deviation(rate: ArrayLike, factors: Integers) -> Array:
    """Return the overlapping Allan deviation at averaging times of `factors` sample periods.

    Parameters
    ----------
    rate : (n,) array
        Evenly spaced samples, rad/s.
    factors : (k,) int array
        From 1 to n/2.

    Returns
    -------
    (k,) array
        rad/s; the square root of ``sum (a[i+2m] - 2 a[i+m] + a[i])^2 / (2 tau^2 (n + 1 - 2m))`` with the angle a.
    """
    samples = np.asarray(rate, dtype=np.float64)
    if samples.ndim != 1 or factors.min() < 1 or 2 * factors.max() > samples.size:
        raise ValueError(f"averaging factors must lie within 1 and half of {samples.size} samples of one axis")
    angle = np.concatenate([[0.0], np.cumsum(samples - samples.mean())])  # in sample periods
    deviation = np.empty(factors.size)
    for k, m in enumerate(factors.tolist()):
        difference = angle[m:] - angle[:-m]
        difference = difference[m:] - difference[:-m]
        deviation[k] = math.sqrt(np.dot(difference, difference) / difference.size / 2.0) / m
    return deviation


def allan_curve(rate: ArrayLike, sample_rate: float, noise: NoiseModel, *, confidence: float = 0.95) -> AllanCurve:
    """Return the Allan deviation of (n,) samples in rad/s, its band as wide as `noise` makes the estimates scatter.

    Raises EstimateError if there are fewer than 3 samples.
    """
    samples = np.asarray(rate, dtype=np.float64)
    factors = averaging_factors(samples.size)
    deviation = overlapping_allan_deviation(samples, factors)
    tau: Array = factors.astype(np.float64) / sample_rate
    edf = np.array([degrees_of_freedom(noise, samples.size, m, 1.0 / sample_rate) for m in factors.tolist()])
    tail = (1.0 - confidence) / 2.0
    return AllanCurve(
        tau=tau,
        deviation=deviation,
        low=deviation * np.sqrt(edf / special.chdtri(edf, tail)),
        high=deviation * np.sqrt(edf / special.chdtri(edf, 1.0 - tail)),
        edf=edf,
        confidence=confidence,
    )


def degrees_of_freedom(noise: NoiseModel, n_samples: int, factor: int, period: float) -> float:
    """Return the equivalent degrees of freedom of the overlapping estimate at `factor` sample periods of `period` s.

    A rate ramp has no scatter and does not enter; without any other noise there is no answer, and ValueError is raised.
    """
    n = n_samples + 1 - 2 * factor
    fine = np.arange(0, 4 * _LAGS_PER_FACTOR + 1) / _LAGS_PER_FACTOR
    coarse = np.geomspace(4.0, max(4.0, n / factor), 200)
    lag = np.unique(np.minimum(np.round(np.concatenate([fine, coarse]) * factor), n - 1))
    smooth = _second_difference_covariance(noise, lag * period, factor * period)
    weighted = (n - lag) * smooth**2
    total = float(np.sum((weighted[1:] + weighted[:-1]) * np.diff(lag)))  # half of lag 0, both signs of all others
    variance = smooth[0] + 6.0 * noise.angle_white_noise**2
    for at, share in ((0, 6.0), (factor, -4.0), (2 * factor, 1.0)):  # where two second differences share an angle
        here = float(np.interp(at, lag, smooth))
        added = (n - at) * ((here + share * noise.angle_white_noise**2) ** 2 - here**2)
        total += max(n - at, 0) and (added if at == 0 else 2.0 * added)
    if not total > 0.0:
        raise ValueError("a noise model without noise tells nothing of the scatter of an estimate")
    return float(max(1.0, (n * variance) ** 2 / total))


def _second_difference_covariance(noise: NoiseModel, lag: Array, tau: float) -> Array:
    """Return the covariance, rad^2, of two second differences over `tau`, `lag` apart, without angle white noise."""
    covariance = np.zeros(lag.size)
    for shift, weight in ((-2, 1.0), (-1, -4.0), (0, 6.0), (1, -4.0), (2, 1.0)):
        h = np.abs(lag + shift * tau) / tau  # scaled, so that nothing overflows
        log = np.log(np.where(h > 0.0, h, 1.0))
        covariance += weight * (
            -(noise.angle_random_walk**2) * tau * h / 2.0
            + (noise.bias_instability * tau) ** 2 / math.pi * h**2 / 2.0 * log
            + noise.rate_random_walk**2 * tau**3 * h**3 / 12.0
        )
    return covariance
