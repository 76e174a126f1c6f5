"""Azimuth from a table of dwells of a single gyro whose bias drifts: only differences of successive dwells are used.

The mean rate of a dwell is ``h . (N, E, V) + bias + noise`` with ``h`` as in `northfinder.estimation.geometry` and a
bias that wanders from dwell to dwell by any amount. Where the dwells come in pairs of opposite attitudes, the half
differences of the pairs hold no bias and do not share any noise: plain least squares (docs/method.md, section 5, double
gyrocompassing at turn angles 0 and 180). In any other order the differences of all successive dwells are used, as
least squares with white noise plus a random walk of the bias, whose ratio is found by restricted maximum likelihood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cholesky_banded, solve_banded
from scipy.optimize import minimize_scalar

from northfinder.errors import EstimateError
from northfinder.estimation.geometry import angles, sensitivity
from northfinder.units import DPH, EARTH_RATE

Array = NDArray[np.float64]

#: Two attitudes are opposite if the input axis turns by 180 deg within about 1 deg.
_OPPOSITE = -math.cos(math.radians(1.0))
#: A horizontal rate is refused if noise alone would show one as large this often.
FALSE_ALARM = 0.01
#: rad; below this the elevations are one and the same, and the vertical rate cannot be told from the bias.
_MIN_ELEVATION_SPAN = math.radians(5.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DwellTableFix:
    """What a table of dwells says. The standard deviations come from its residuals."""

    azimuth: float  #: rad, true azimuth of stage azimuth zero, in [0, 2 pi)
    azimuth_sd: float
    horizontal_rate: float  #: rad/s, amplitude over stage azimuth; ideally Omega cos(lat)
    horizontal_rate_sd: float
    latitude: float | None  #: rad; as given, or from dwells at other elevations, or unknown
    latitude_sd: float | None
    scale_factor: float | None  #: None with the latitude unknown
    scale_factor_sd: float | None
    bias: float  #: rad/s, mean over the dwells
    noise_sd: float  #: rad/s, white noise of one dwell
    bias_step_sd: float | None  #: rad/s, random walk of the bias from dwell to dwell; None from half differences
    n_dwells: int
    degrees_of_freedom: int
    method: str  #: "half differences" or "random walk"


def solve_dwell_table(
    azimuth: ArrayLike,
    elevation: ArrayLike,
    rate: ArrayLike,
    *,
    input_axis_offset: float = 0.0,
    latitude: float | None = None,
) -> DwellTableFix:
    """Return the azimuth of stage zero, the horizontal rate and what follows from them.

    Parameters
    ----------
    azimuth, elevation, rate : (n,) arrays
        Stage angles (rad) and mean rates (rad/s), in the order of time.
    input_axis_offset : float
        Where the input axis points at stage azimuth zero, rad, clockwise from above: pi if it points backward.
    latitude : float, optional
        Known latitude, rad; the scale factor follows from it.

    Raises
    ------
    EstimateError
        With too few dwells, with attitudes that do not tell north from east, or if the horizontal rate is not
        distinguishable from zero.
    """
    azimuth, elevation, rate = (np.asarray(a, dtype=np.float64) for a in (azimuth, elevation, rate))
    if len(rate) < 2:
        raise EstimateError(f"{len(rate)} dwells are too few, expected at least 4")
    design = sensitivity(azimuth + input_axis_offset, elevation, np.zeros((len(rate), 2)))[:, 0, :]
    n_unknowns = 3 if np.ptp(elevation) > _MIN_ELEVATION_SPAN else 2
    h = design[:, :n_unknowns]
    fit = _half_differences(h, rate) if _comes_in_pairs(design) else _random_walk(h, rate)
    _check_horizontal(fit)
    return _result(fit, h, rate, latitude)


@dataclass(frozen=True, slots=True)
class _Fit:
    rates: Array  #: N, E and perhaps V
    covariance: Array
    degrees_of_freedom: int
    noise_sd: float
    bias_step_sd: float | None
    method: str


def _comes_in_pairs(design: Array) -> bool:
    first, second = design[:-1:2], design[1::2]
    return len(design) % 2 == 0 and bool(np.all(np.sum(first * second, axis=1) < _OPPOSITE))


def _half_differences(h: Array, rate: Array) -> _Fit:
    rates, covariance, freedom, sd = _least_squares((h[:-1:2] - h[1::2]) / 2.0, (rate[:-1:2] - rate[1::2]) / 2.0)
    return _Fit(rates, covariance, freedom, sd * math.sqrt(2.0), None, "half differences")


def _random_walk(h: Array, rate: Array) -> _Fit:
    """Solve from the differences of successive dwells: covariance ``noise^2`` times ``2 + q``, and ``-1`` beside it."""
    h_step, rate_step = np.diff(h, axis=0), np.diff(rate)

    def whitened(log_q: float) -> tuple[Array, Array, float]:
        band = np.vstack([np.full(len(rate_step), 2.0 + math.exp(log_q)), np.full(len(rate_step), -1.0)])
        lower = cholesky_banded(band, lower=True)
        white = solve_banded((1, 0), lower, np.column_stack([h_step, rate_step]))
        return white[:, :-1], white[:, -1], 2.0 * float(np.log(lower[0]).sum())

    def criterion(log_q: float) -> float:
        design, values, log_determinant = whitened(log_q)
        _, _, _, sd = _least_squares(design, values, n_lost=1)
        spread = 2.0 * (len(values) - design.shape[1]) * math.log(max(sd, 1e-300))
        return float(log_determinant + spread + float(np.linalg.slogdet(design.T @ design).logabsdet))

    coarse = min(np.linspace(-12.0, 8.0, 21), key=criterion)
    log_q = float(minimize_scalar(criterion, bounds=(coarse - 1.0, coarse + 1.0), method="bounded").x)
    design, values, _ = whitened(log_q)
    rates, covariance, freedom, sd = _least_squares(design, values, n_lost=1)
    return _Fit(rates, covariance, freedom, sd, sd * math.exp(log_q / 2.0), "random walk")


def _least_squares(design: Array, values: Array, *, n_lost: int = 0) -> tuple[Array, Array, int, float]:
    """Return solution, covariance, degrees of freedom (less `n_lost`) and residual standard deviation."""
    freedom = len(values) - int(design.shape[1]) - n_lost
    if freedom < 1:
        raise EstimateError(f"{len(values)} differences of dwells are too few for {design.shape[1]} rates and their sd")
    singular = np.linalg.svd(design, compute_uv=False)
    if singular[-1] <= 1e-3 * singular[0]:
        raise EstimateError("the dwells do not tell north from east: more stage azimuths are needed")
    inverse = np.asarray(np.linalg.inv(design.T @ design), dtype=np.float64)
    solution = inverse @ design.T @ values
    sd = math.sqrt(float(np.sum((values - design @ solution) ** 2)) / freedom)
    return solution, inverse * sd**2, freedom, sd


def _check_horizontal(fit: _Fit) -> None:
    """Raise unless an F test (2 and f degrees of freedom, closed form) tells the horizontal rate from noise."""
    horizontal, covariance = fit.rates[:2], fit.covariance[:2, :2]
    if not horizontal.any():
        raise EstimateError("the horizontal rate is zero")
    if not covariance.any():
        return
    ratio = float(horizontal @ np.linalg.solve(covariance, horizontal)) / 2.0
    chance = (1.0 + 2.0 * ratio / fit.degrees_of_freedom) ** (-fit.degrees_of_freedom / 2.0)
    if chance > FALSE_ALARM:
        size, sd = np.hypot(*horizontal) / DPH, math.sqrt(float(np.trace(covariance)) / 2.0) / DPH
        raise EstimateError(
            f"the horizontal rate {size:.2f} +- {sd:.2f} deg/h is not distinguishable from zero "
            f"(noise alone gives as much with a chance of {chance:.2g})"
        )


def _result(fit: _Fit, h: Array, rate: Array, latitude: float | None) -> DwellTableFix:
    n, e = (float(x) for x in fit.rates[:2])
    horizontal = math.hypot(n, e)
    to_azimuth, to_horizontal = np.array([-e, n]) / horizontal**2, np.array([n, e]) / horizontal
    horizontal_sd = _sd(to_horizontal, fit.covariance)
    latitude_sd, scale, scale_sd = None, None, None
    if latitude is not None:
        earth = EARTH_RATE * math.cos(latitude)
        latitude_sd, scale, scale_sd = 0.0, horizontal / earth, horizontal_sd / earth
    elif len(fit.rates) == 3:
        v = float(fit.rates[2])
        total = math.hypot(horizontal, v)
        latitude, scale = math.atan2(v, horizontal), total / EARTH_RATE
        latitude_sd = _sd(np.array([*(-v * to_horizontal), horizontal]) / total**2, fit.covariance)
        scale_sd = _sd(fit.rates / total, fit.covariance) / EARTH_RATE
    return DwellTableFix(
        azimuth=float(angles(np.array([n, e, 0.0]))[0]),
        azimuth_sd=_sd(to_azimuth, fit.covariance),
        horizontal_rate=horizontal,
        horizontal_rate_sd=horizontal_sd,
        latitude=latitude,
        latitude_sd=latitude_sd,
        scale_factor=scale,
        scale_factor_sd=scale_sd,
        bias=float(np.mean(rate - h @ fit.rates)),
        noise_sd=fit.noise_sd,
        bias_step_sd=fit.bias_step_sd,
        n_dwells=len(rate),
        degrees_of_freedom=fit.degrees_of_freedom,
        method=fit.method,
    )


def _sd(gradient: Array, covariance: Array) -> float:
    n = len(gradient)
    return math.sqrt(max(float(gradient @ covariance[:n, :n] @ gradient), 0.0))
