"""The one linear model: ``rate = h . (N, E, V) + bias terms + noise``, for any order of positions and any drift."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from northfinder.errors import EstimateError
from northfinder.estimation.geometry import sensitivity
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.whitening import whiten

Array = NDArray[np.float64]

#: How the bias runs: constant, linear in time, or a constant of its own for every two successive dwells.
Drift = Literal["constant", "linear", "pairs"]

#: A quantity whose column of the design, the other columns taken out, keeps less than this part is not determined.
NOT_DETERMINED = {"N": 0.01, "E": 0.01, "V": 1e-6, "bias": 1e-6}
_REASON = {
    "N": "the part of the earth rate along stage azimuth 0 deg: measure at two azimuths about 180 deg apart near it",
    "E": "the part of the earth rate along stage azimuth 90 deg: measure at two azimuths about 180 deg apart near it",
    "bias": "the bias and its drift: measure at more positions, or take a simpler drift",
}


@dataclass(frozen=True, slots=True)
class Design:
    """Columns of the linear model: N, E, V, then the bias terms of each axis. Axes follow one another in the rows."""

    means: RateMeans
    sensitivity: Array  #: (n, n_axes, 3)
    bias: Array  #: (n, n_bias), the same for each axis
    drift: Drift
    bias_known: bool  #: whether the biases are zero within a standard deviation, and need not be measured
    vertical: float  #: part of the column of V that the other columns leave: a sine of elevation

    @property
    def matrix(self) -> Array:
        """The design, shape (n_axes n, 3 + n_axes n_bias)."""
        return _stack(self.sensitivity, self.bias)

    @property
    def mean_biases(self) -> Array:
        """What takes the coefficients to the mean bias of each axis, shape (n_axes, 3 + n_axes n_bias)."""
        return _mean_biases(self.means.n_axes, self.bias)

    def whitened(self, noise: NoiseModel, rate: Array) -> tuple[Array, Array]:
        """Return design and rates, (n, n_axes), with the covariance of the noise taken out of the rows."""
        n_axes, n_bias = self.means.n_axes, self.bias.shape[1]
        columns = np.hstack([self.sensitivity.reshape(len(rate), -1), self.bias, rate])
        white = whiten(noise, self.means, columns)
        h, bias, white_rate = np.split(white, [3 * n_axes, 3 * n_axes + n_bias], axis=1)
        return _stack(h.reshape(-1, n_axes, 3), bias), white_rate.T.ravel()


def _stack(h: Array, bias: Array) -> Array:
    """Return the rows of all axes, one axis after the other, each axis with bias terms of its own."""
    return np.hstack([h.swapaxes(0, 1).reshape(-1, 3), np.kron(np.eye(h.shape[1]), bias)])


def _mean_biases(n_axes: int, bias: Array) -> Array:
    return np.hstack([np.zeros((n_axes, 3)), np.kron(np.eye(n_axes), bias.mean(axis=0))])


def build_design(means: RateMeans, drift: Drift, *, bias_known: bool = False) -> Design:
    """Return the design for `means`. Raises EstimateError naming what these positions cannot determine, but for V.

    The slope of a linear drift is taken about the middle of the data, and over half their span. A known bias is as
    good as rows that measure it.
    """
    if drift == "pairs":
        pair = np.unique(means.dwell, return_inverse=True)[1] // 2
        bias = (pair[:, np.newaxis] == np.arange(pair[-1] + 1)).astype(np.float64)
    elif drift == "linear":
        bias = np.column_stack([_of_turn_ons(means), reduced_time(means)])
    else:
        bias = _of_turn_ons(means)
    h = sensitivity(means.azimuth, means.elevation, means.tilt, n_axes=means.n_axes)
    rows = _stack(h, bias)
    if bias_known:
        rows = np.vstack([rows, math.sqrt(means.n) * _mean_biases(means.n_axes, bias)])
    return Design(means, h, bias, drift, bias_known, vertical=_check_determined(rows))


def _of_turn_ons(means: RateMeans) -> Array:
    """Return a column of ones for each turn-on of the gyro, zero in the rows of the others."""
    turn_ons = np.unique(means.turn_on)
    return np.asarray(means.turn_on[:, np.newaxis] == turn_ons, dtype=np.float64)


def per_dwell(design: Design) -> Design | None:
    """Return the design of the dwell means of `design`; None if they are the same, or too few to leave a residual."""
    means = design.means.per_dwell()
    unknowns = 3 + means.n_axes * (design.bias.shape[1] - design.bias_known)
    if means.n == design.means.n or means.n * means.n_axes <= unknowns:
        return None
    return build_design(means, design.drift, bias_known=design.bias_known)


def reduced_time(means: RateMeans) -> Array:
    """Return the time of each mean from the middle of the data, over `half_span`."""
    return (means.middle - np.mean(means.middle)) / half_span(means)


def half_span(means: RateMeans) -> float:
    """Return half the time from the first start to the last end, s."""
    return float(means.start[-1] + means.duration[-1] - means.start[0]) / 2.0


def _check_determined(matrix: Array) -> float:
    """Return how well the positions measure V, 0 if not. Raises EstimateError naming anything else that they do not."""
    kept, names = _kept(matrix), ["N", "E", "V"]
    vertical = float(kept[2])
    if vertical < NOT_DETERMINED["V"]:
        vertical, kept, names = 0.0, _kept(np.delete(matrix, 2, axis=1)), ["N", "E"]
    if matrix.shape[0] < kept.size:
        what = f"{matrix.shape[0]} means cannot determine {kept.size} unknowns"
        raise EstimateError(f"{what}: measure at more positions, or take a simpler drift")
    names += ["bias"] * (kept.size - len(names))
    for name, part in zip(names, kept, strict=True):
        if part < NOT_DETERMINED[name]:
            raise EstimateError(f"these positions do not determine {_REASON[name]}")
    return vertical


def _kept(matrix: Array) -> Array:
    """Return the part of each column that the other columns cannot explain, relative to a column of ones."""
    triangle = linalg.qr(matrix, mode="r")[0][: matrix.shape[1]]
    kept = np.empty(matrix.shape[1])
    for column in range(kept.size):
        rest = np.delete(triangle, column, axis=1)
        unexplained = triangle[:, column] - rest @ linalg.lstsq(rest, triangle[:, column])[0]
        kept[column] = np.linalg.norm(unexplained) / np.sqrt(matrix.shape[0])
    return kept


@dataclass(frozen=True, slots=True, eq=False)
class LinearFit:
    """Least squares of one design: coefficients, what maps the rows to them, and the sum of squared residuals."""

    coefficients: Array  #: (p,)
    inverse: Array  #: (p, rows), maps the rows of the data to the coefficients
    by_vertical: Array  #: (p,), what the assumed V does to the coefficients; zero where V is measured
    by_bias: Array  #: (p, n_axes), what the known bias of each axis does to them; no columns where none is known
    assumed: Array  #: (p, p), covariance that the assumed V and the known biases bring
    chi2: float
    dof: int


@dataclass(frozen=True, slots=True, eq=False)
class KnownBias:
    """Rows that say that each axis's mean bias is zero, and how much one counts against a row of data."""

    rows: Array  #: (n_axes, p)
    sd: float  #: rad/s
    row_sd: float  #: of a row of data, in its unit


def least_squares(
    matrix: Array, rate: Array, vertical: tuple[float, float] | None, bias: KnownBias | None = None
) -> LinearFit:
    """Solve ``matrix x = rate``; `vertical` is V and its standard deviation where it is assumed, not measured."""
    n, p = matrix.shape
    if bias is not None:
        weight = bias.row_sd / bias.sd
        matrix, rate = np.vstack([matrix, weight * bias.rows]), np.append(rate, np.zeros(len(bias.rows)))
    free = np.arange(p) != (-1 if vertical is None else 2)
    q, r = linalg.qr(matrix[:, free], mode="economic")
    inverse = np.zeros(matrix.T.shape)
    inverse[free] = linalg.inv(r) @ q.T
    value, sd = vertical or (0.0, 0.0)
    by_vertical = np.zeros(p)
    if vertical is not None:
        by_vertical = -inverse @ matrix[:, 2]
        by_vertical[2] = 1.0
    coefficients = inverse @ rate + value * by_vertical
    residual = rate - matrix @ coefficients
    by_bias = inverse[:, n:] if bias is None else weight * inverse[:, n:]
    assumed = sd**2 * np.outer(by_vertical, by_vertical)
    if bias is not None:
        assumed += bias.sd**2 * by_bias @ by_bias.T
    dof = matrix.shape[0] - int(free.sum())
    return LinearFit(coefficients, inverse[:, :n], by_vertical, by_bias, assumed, float(residual @ residual), dof)
