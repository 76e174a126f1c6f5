"""The gyro's noise model, and the exact covariance that it gives to interval means.

Coefficients and Allan variance after IEEE Std 952, annex C. Each noise adds to the covariance of the means over two
intervals of lengths T (start s, end e, middle m, in order of time):

=====================  ===================================================================================
angle white noise q    rate is the difference of white angle noise: ``2 q^2/T^2`` for a mean with itself,
                       ``-q^2/(T1 T2)`` for neighbours that share an end point
angle random walk N    ``N^2/T`` for a mean with itself
bias instability B     1/f, spectral density ``B^2/(2 pi f)``, covariance ``-(B^2/pi) ln|t|`` and a constant
rate random walk K     ``K^2 (m1 - t0)`` for two means, ``K^2 (s - t0 + T/3)`` for a mean with itself
rate ramp R            ``R^2 (m1 - t0)(m2 - t0)``: a slope of unknown size
=====================  ===================================================================================

The constant of the 1/f noise and the origin t0 are arbitrary: a constant bias is always estimated beside them. The 1/f
noise is a sum of first-order Gauss-Markov processes, time constants in the ratio 4, each of variance
``B^2 ln 4/pi``; what is faster than the shortest interval or slower than the span goes into the two random walks. The
variance of the difference of any two means follows the logarithm within 0.1 %, and the same noise can be filtered in
one pass (`whitening`), to the same figures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from northfinder.estimation.means import RateMeans
from northfinder.units import DPH

Array = NDArray[np.float64]

_HOUR = 3600.0  # s
_RATIO = 4.0  # of neighbouring time constants: the ripple of the sum is 0.2 % of B^2/pi
_FASTEST = 0.1  # of the shortest interval
_SLOWEST = 10.0  # of the whole span


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise coefficients of one gyro axis, SI. Raises ValueError if one is negative or not finite."""

    angle_white_noise: float = 0.0  #: rad, sd of the white angle
    angle_random_walk: float = 0.0  #: rad/sqrt(s)
    bias_instability: float = 0.0  #: rad/s
    rate_random_walk: float = 0.0  #: rad/s/sqrt(s)
    rate_ramp: float = 0.0  #: rad/s^2

    def __post_init__(self) -> None:
        """Check that every coefficient can be one."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{field.name} must be zero or positive, not {value}")

    @classmethod
    def from_field_units(
        cls,
        *,
        angle_white_noise_dph_s: float = 0.0,
        angle_random_walk_deg_per_sqrt_h: float = 0.0,
        bias_instability_dph: float = 0.0,
        rate_random_walk_dph_per_sqrt_h: float = 0.0,
        rate_ramp_dph_per_h: float = 0.0,
    ) -> NoiseModel:
        """Return the model from a data sheet's units: deg/h*s, deg/sqrt(h), deg/h, deg/h/sqrt(h), deg/h/h."""
        return cls(
            angle_white_noise=angle_white_noise_dph_s * DPH,
            angle_random_walk=angle_random_walk_deg_per_sqrt_h * math.radians(1.0) / math.sqrt(_HOUR),
            bias_instability=bias_instability_dph * DPH,
            rate_random_walk=rate_random_walk_dph_per_sqrt_h * DPH / math.sqrt(_HOUR),
            rate_ramp=rate_ramp_dph_per_h * DPH / _HOUR,
        )

    def allan_deviation(self, tau: ArrayLike) -> Array:
        """Return the Allan deviation, rad/s, at the averaging times `tau`, s (IEEE Std 952, annex C)."""
        tau = np.asarray(tau, dtype=np.float64)
        variance = (
            3.0 * (self.angle_white_noise / tau) ** 2
            + self.angle_random_walk**2 / tau
            + (2.0 * math.log(2.0) / math.pi) * self.bias_instability**2
            + self.rate_random_walk**2 * tau / 3.0
            + (self.rate_ramp * tau) ** 2 / 2.0
        )
        return np.asarray(np.sqrt(variance))

    def covariance(self, means: RateMeans) -> Array:
        """Return the covariance of the mean rates of one axis, rad^2/s^2, shape (n, n)."""
        parts = components(self, means)
        start, duration, middle = means.start - means.start[0], means.duration, means.middle - means.start[0]
        cov: Array = parts.rate_random_walk**2 * np.minimum.outer(middle, middle)
        cov += self.rate_ramp**2 * np.outer(middle, middle)
        np.fill_diagonal(cov, cov.diagonal() + parts.rate_random_walk**2 * (start + duration / 3.0 - middle))
        for tau in parts.time_constants:
            cov += parts.variance * _gauss_markov(start, duration, tau)
        diagonal = parts.angle_random_walk**2 / duration + 2.0 * (self.angle_white_noise / duration) ** 2
        np.fill_diagonal(cov, cov.diagonal() + diagonal)
        shared = np.flatnonzero(means.gap == 0.0)
        link = -(self.angle_white_noise**2) / (duration[shared] * duration[shared + 1])
        cov[shared, shared + 1] += link
        cov[shared + 1, shared] += link
        return cov


@dataclass(frozen=True, slots=True)
class Components:
    """A noise model as processes that a state-space model can hold: the 1/f noise as Gauss-Markov processes."""

    time_constants: tuple[float, ...]  #: s
    variance: float  #: of each Gauss-Markov process, rad^2/s^2
    angle_random_walk: float  #: rad/sqrt(s), with the faster processes
    rate_random_walk: float  #: rad/s/sqrt(s), with the slower processes


def components(noise: NoiseModel, means: RateMeans) -> Components:
    """Return the processes that stand for `noise` on the time scales of `means`.

    A process faster than every interval acts as angle random walk, ``N^2 = 2 variance tau``; one slower than the whole
    span acts, beside a constant, as rate random walk, ``K^2 = 2 variance/tau``. Both sums are geometric.
    """
    if noise.bias_instability == 0.0:
        return Components((), 0.0, noise.angle_random_walk, noise.rate_random_walk)
    span = means.start[-1] + means.duration[-1] - means.start[0]
    fastest = math.floor(math.log(_FASTEST * means.duration.min(), _RATIO))
    slowest = math.ceil(math.log(_SLOWEST * span, _RATIO))
    variance = noise.bias_instability**2 * math.log(_RATIO) / math.pi
    tail = 2.0 * variance / (_RATIO - 1.0)
    return Components(
        time_constants=tuple(_RATIO**k for k in range(fastest, slowest + 1)),
        variance=variance,
        angle_random_walk=math.sqrt(noise.angle_random_walk**2 + tail * _RATIO**fastest),
        rate_random_walk=math.sqrt(noise.rate_random_walk**2 + tail / _RATIO**slowest),
    )


def _gauss_markov(start: Array, duration: Array, tau: float) -> Array:
    """Return the covariance of interval means of ``exp(-|t|/tau)``, integrated over both intervals."""
    x = duration / tau
    weight = -np.expm1(-x) / x
    end = start + duration
    between = np.maximum(start[np.newaxis, :] - end[:, np.newaxis], 0.0)
    cov = np.triu(np.outer(weight, weight) * np.exp(-between / tau), 1)
    cov += cov.T
    np.fill_diagonal(cov, mean_variance(x))
    return cov


def mean_variance(x: Array) -> Array:
    """Return ``2 (x - 1 + exp(-x))/x^2``, the variance of the mean over x time constants, also for small x."""
    series = 1.0 - x / 3.0 + x**2 / 12.0 - x**3 / 60.0 + x**4 / 360.0
    with np.errstate(over="ignore"):
        exact = 2.0 * (x + np.expm1(-x)) / x**2
    return cast("Array", np.where(x < 0.01, series, exact))
