"""Noise coefficients from a static record: maximum likelihood over its spectrum (docs/method.md, section 6).

The discrete cosine transform takes a random walk, white noise, and by their self-similarity nearly 1/f noise, to
independent coefficients without leakage, where the periodogram of a drifting rate leaks. The expected power of each is
a sum of known spectra times the squares of the noise coefficients, so the likelihood is that of a gamma regression with
non-negative coefficients; its solution is a least-squares fit with weights that follow from the fit itself.

Three regressors are fitted beside the spectra: a linear trend, which is the rate ramp, and the two end angles, whose
white noise the neighbouring dwell would cancel. The likelihood is the restricted one, which allows for them.

A real gyro has filters and resonances that no coefficient describes. So means over `SHORTEST_MEAN` are taken first,
which leaves all five coefficients as they are; and a relative model error of the power in each band is estimated after
Mandel and Paule (Anal. Chem. 42, 1970, p. 1194) when the fit is worse than chance allows, which takes the weight off
bands that would else rule the fit by the mere number of their samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats
from scipy.fft import dct
from scipy.optimize import brentq

from northfinder.errors import EstimateError
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.power_fit import PowerFit

Array = NDArray[np.float64]

#: Names of the coefficients as in `NoiseModel`, the ramp last.
KINDS = ("angle_white_noise", "angle_random_walk", "bias_instability", "rate_random_walk", "rate_ramp")
#: The record is reduced to means at least this long, s: a gyro's filters shape what is faster.
SHORTEST_MEAN = 0.1
MIN_MEANS = 100
#: A trend is called a ramp from so many sd on: the random walks beside it are themselves known but roughly.
RAMP_SDS = 2.5
_ONE_SIDED_95 = 1.645  # sd of a Gaussian number
_IMPROBABLE = 0.01  # chance below which a poor fit is the model's fault
_ROUNDS = 8  # of regressors, spectra and model error in turn; the third changes nothing any more
_SINGLE = 12  # the slowest coefficients each make a band of their own
_BANDS_PER_OCTAVE = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Coefficient:
    """One identified noise coefficient, SI as in `NoiseModel`. Not observable: value 0, no sd, a bound instead."""

    name: str
    value: float
    sd: float | None
    upper_bound: float | None  #: 95 %, of one that is not observable

    @property
    def observable(self) -> bool:
        """Whether the record supports it."""
        return self.sd is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """The noise of a gyro as one static record shows it."""

    coefficients: tuple[Coefficient, ...]  #: in the order of `KINDS`
    model_error: float  #: relative sd of the power in a band against the model; 0 if chance explains the residuals
    mean_interval: float  #: of the means the coefficients come from, s

    @property
    def noise(self) -> NoiseModel:
        """The coefficients as a noise model."""
        return NoiseModel(**{each.name: each.value for each in self.coefficients})


def identify(rate: ArrayLike, sample_rate: float) -> Identification:
    """Identify the noise coefficients from an unbroken static record.

    Parameters
    ----------
    rate : (n,) array
        Samples, rad/s.
    sample_rate : float
        Hz.

    Returns
    -------
    Identification

    Raises
    ------
    EstimateError
        The record is too short, its rate never changes, or it is a curve without noise.
    """
    per_mean = max(1, round(SHORTEST_MEAN * sample_rate))
    samples = np.asarray(rate, dtype=np.float64)
    n = samples.size // per_mean
    period = per_mean / sample_rate
    if n < MIN_MEANS:
        raise EstimateError(
            f"{samples.size / sample_rate:g} s are too short a record: expected {MIN_MEANS * period:g} s or more"
        )
    means = samples[: n * per_mean].reshape(n, per_mean).mean(axis=1)
    if np.ptp(means) == 0.0:
        raise EstimateError("the rate never changes within the record, so it holds no noise to identify")
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            return _identify(_Bands.of(means, period))
    except (FloatingPointError, np.linalg.LinAlgError):
        raise EstimateError("the rate follows a curve without noise, so there is none to identify") from None


@dataclass(frozen=True, slots=True, eq=False)
class _Bands:
    """The record's spectrum, summed over bands of neighbouring coefficients; b bands."""

    period: float  #: s
    size: Array  #: coefficients in each band, shape (b,)
    moments: Array  #: sums of products of (data, trend, first angle, last angle), shape (b, 4, 4)
    spectra: Array  #: expected power for unit squares of the first four coefficients, shape (b, 4)

    @classmethod
    def of(cls, means: Array, period: float) -> _Bands:
        n = means.size
        k = np.arange(1, n)
        edge = math.sqrt(2.0 / n) * np.cos(math.pi * k / (2 * n)) / period
        trend = (np.arange(n) - 0.5 * (n - 1)) * period
        data, ramp = (dct(column, norm="ortho")[1:] for column in (means - means.mean(), trend))
        columns = (data, ramp, edge, edge * (-1.0) ** k)
        first = _band_edges(n)
        size = np.diff(np.append(first, n - 1)).astype(np.float64)
        moments = np.empty((size.size, 4, 4))
        for i, one in enumerate(columns):
            for j, other in enumerate(columns):
                moments[:, i, j] = np.add.reduceat(one * other, first)
        spectra = np.add.reduceat(_spectra(k, n, period), first, axis=0) / size[:, np.newaxis]
        return cls(period, size, moments, spectra)


def _band_edges(n: int) -> NDArray[np.int64]:
    """Return where each band starts among the n - 1 coefficients."""
    n_octaves = max(0.0, math.log2((n - 1) / _SINGLE))
    wide = _SINGLE * 2.0 ** (np.arange(math.ceil(n_octaves * _BANDS_PER_OCTAVE)) / _BANDS_PER_OCTAVE)
    return np.unique(np.concatenate([np.arange(min(_SINGLE, n - 1)), np.round(wide)]).astype(np.int64))


def _spectra(k: NDArray[np.int64], n: int, period: float) -> Array:
    """Return the expected power of coefficient k of n interval means for q, N, B, K of one each, shape (n - 1, 4).

    1/f: the spectrum ``B^2/(2 pi f)`` of the means with its aliases (Hurwitz zeta function), times the share that the
    finite record leaves of it, from the integral of ``-ln|t - t'|`` over two cosines.
    """
    x = k / (2.0 * n)  # frequency in cycles a period
    a = math.pi * k
    steep = 4.0 * np.sin(math.pi * x) ** 2
    share = (special.sici(a)[0] - (1.0 - np.cos(a)) / a) / (math.pi / 2.0)
    flicker = steep * (special.zeta(3.0, x) + special.zeta(3.0, 1.0 - x)) / (8.0 * math.pi**3)
    return np.column_stack(
        [steep / period**2, np.full(k.size, 1.0 / period), flicker * share, period * (1.0 / steep - 1.0 / 6.0)]
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Residual:
    """What the three regressors leave of the power."""

    power: Array  #: per degree of freedom, shape (b,)
    dof: Array  #: shape (b,)
    slope: float  #: rad/s^2
    slope_sd: float


def _regress(bands: _Bands, variance: Array) -> _Residual:
    """Fit the regressors by generalised least squares, given the variance of each band's coefficients."""
    scale = np.sqrt(np.einsum("bii->i", bands.moments))
    moments = bands.moments / np.outer(scale, scale)
    weighted = np.einsum("bij,b->ij", moments, scale[0] ** 2 / variance)
    cov = np.linalg.inv(weighted[1:, 1:])
    fit = cov @ weighted[1:, 0]
    residual = np.concatenate([[1.0], -fit])
    square = np.einsum("i,bij,j->b", residual, moments, residual) * scale[0] ** 2
    leverage = np.einsum("bij,ji->b", moments[:, 1:, 1:], cov) * scale[0] ** 2 / variance
    dof = np.maximum(bands.size - leverage, 1e-6)
    unit = float(scale[0] / scale[1])
    return _Residual(square / dof, dof, float(fit[0]) * unit, math.sqrt(cov[0, 0]) * unit)


def _identify(bands: _Bands) -> Identification:
    power = bands.moments[:, 0, 0] / bands.size
    scale = 1.0 / np.max(bands.spectra / power[:, np.newaxis], axis=0)  # the most of each that the power has room for
    spectra = bands.spectra * scale
    weights = np.full(4, 0.25)
    for _ in range(_ROUNDS):
        variance = spectra @ weights
        residual = _regress(bands, variance)
        model_error = _model_error(bands.size, residual.power / variance - 1.0)
        fit = PowerFit(residual.power, residual.dof / (1.0 + 0.5 * residual.dof * model_error**2), spectra)
        weights = fit.reduced(fit.maximum(weights))
    sds, scales = fit.sds(weights).tolist(), scale.tolist()
    squares = [
        _from_square(name, weight, sds[i], None if weight else fit.upper_bound(weights, i), scales[i])
        for i, (name, weight) in enumerate(zip(KINDS, weights.tolist(), strict=False))
    ]
    coefficients = (*squares, _ramp(residual))
    return Identification(coefficients=coefficients, model_error=model_error, mean_interval=bands.period)


def _from_square(name: str, weight: float, sd: float, bound: float | None, scale: float) -> Coefficient:
    """Return a coefficient from its square, ``weight * scale``."""
    if bound is not None:
        return Coefficient(name=name, value=0.0, sd=None, upper_bound=math.sqrt(bound * scale))
    value = math.sqrt(weight * scale)
    return Coefficient(name=name, value=value, sd=0.5 * value * sd / weight, upper_bound=None)


def _ramp(residual: _Residual) -> Coefficient:
    """Return the trend as a rate ramp, if the random walks fitted beside it do not explain it."""
    size, sd = abs(residual.slope), residual.slope_sd
    if size > RAMP_SDS * sd:
        return Coefficient(name=KINDS[-1], value=size, sd=sd, upper_bound=None)
    return Coefficient(name=KINDS[-1], value=0.0, sd=None, upper_bound=size + _ONE_SIDED_95 * sd)


def _model_error(size: Array, excess: Array) -> float:
    """Return the relative sd of the model that brings the excess power of the bands to its expected scatter."""
    many = size >= _SINGLE  # where the power is nearly Gaussian
    n = int(np.count_nonzero(many)) - 4
    if n < 1:
        return 0.0

    def surplus(model_error: float, expected: float) -> float:
        return float(np.sum(excess[many] ** 2 / (2.0 / size[many] + model_error**2))) - expected

    if surplus(0.0, stats.chi2.ppf(1.0 - _IMPROBABLE, n)) <= 0.0:
        return 0.0
    largest = 2.0 * math.sqrt(float(np.sum(excess[many] ** 2)))
    return float(brentq(surplus, 0.0, largest, args=(n,)))
