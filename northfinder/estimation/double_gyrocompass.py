"""Double gyrocompassing: what one triad at rest in several positions tells, its gyro biases among it.

The positions of one body share the biases ``b`` of its gyros. With ``u_p`` up in the body frame, from the
accelerometers, least squares over all positions ``p`` (docs/method.md, section 5),

    w_p = b + Omega (cos lat north_p(heading_p) + sin lat u_p),

finds the three biases, the latitude and one heading a position. The turns between the positions need not be known, as
long as they were not all about the vertical; those need the turn angles, as in the source's [S1] (11) to (16).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from northfinder.errors import EstimateError
from northfinder.estimation.triad import (
    HEADING_SD_MAX,
    StaticMean,
    TriadFix,
    axis_directions,
    check_gravity,
    directions,
    gyrocompass,
    propagated,
    unit,
)
from northfinder.units import DPH, EARTH_RATE

Array = NDArray[np.float64]
_LEAST_NOISE = 1e-9  # of a mean rate, in units of Omega
_STEPS, _CONVERGED = 20, 1e-13  # of Gauss-Newton, in units of x
#: In the body frame of each position, (n, 3) each: a level direction, that 90 deg clockwise of it from above, and up.
Level = tuple[Array, Array, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class TriadSolution:
    """The fix from all positions together, and that from each alone."""

    combined: TriadFix
    positions: tuple[TriadFix, ...]


def solve_triad(
    means: Sequence[StaticMean],
    *,
    gyro_bias_sd: float | None = None,
    accelerometer_bias_sd: float = 0.0,
    latitude: float | None = None,
    turns: ArrayLike | None = None,
    turn_sd: float = 0.0,
    rate_covariance: Array | None = None,
) -> TriadSolution:
    """Return what one position says, or several by double gyrocompassing; parameters as `double_gyrocompass`.

    With several positions and no `gyro_bias_sd`, the standard deviations of each position alone hold biases of the
    size that all together show.

    Raises
    ------
    EstimateError
        As `double_gyrocompass` and `gyrocompass`, and if no body axis has an azimuth.
    """
    if not means:
        raise EstimateError("there is no position to solve")
    if len(means) == 1:
        combined = gyrocompass(means[0], gyro_bias_sd=gyro_bias_sd, accelerometer_bias_sd=accelerometer_bias_sd)
    else:
        combined = double_gyrocompass(
            means,
            gyro_bias_sd=gyro_bias_sd,
            accelerometer_bias_sd=accelerometer_bias_sd,
            latitude=latitude,
            turns=turns,
            turn_sd=turn_sd,
            rate_covariance=rate_covariance,
        )
    if all(axis.azimuth is None for axes in combined.axes for axis in axes):
        raise EstimateError(f"no azimuth: {max((axis.reason for axis in combined.axes[0]), key=len)}")
    if gyro_bias_sd is None and combined.bias is not None and combined.bias_sd is not None:
        gyro_bias_sd = math.sqrt(float(np.mean(combined.bias**2 + combined.bias_sd**2)))
    alone = (gyrocompass(m, gyro_bias_sd=gyro_bias_sd, accelerometer_bias_sd=accelerometer_bias_sd) for m in means)
    return TriadSolution(combined=combined, positions=tuple(alone))


def double_gyrocompass(
    means: Sequence[StaticMean],
    *,
    gyro_bias_sd: float | None = None,
    accelerometer_bias_sd: float = 0.0,
    latitude: float | None = None,
    turns: ArrayLike | None = None,
    turn_sd: float = 0.0,
    rate_covariance: Array | None = None,
) -> TriadFix:
    """Return latitude, common gyro biases and axis directions from several positions of one body.

    Residuals larger than the noise, where there are more equations than unknowns, scale the standard deviations up.

    Parameters
    ----------
    means : sequence of StaticMean
        At least two positions.
    gyro_bias_sd : float, optional
        If given, each bias is known beforehand to be zero within it, rad/s.
    accelerometer_bias_sd : float
        Of the biases, common to all positions, m/s^2.
    latitude : float, optional
        The latitude, rad, if it is known.
    turns : (n_positions,) array, optional
        Known turn of each position about the vertical, clockwise from above, rad; only their differences matter.
    turn_sd : float
        Standard deviation of each, rad.
    rate_covariance : (n_positions, n_positions) array, optional
        Of the mean rates of one gyro, rad^2/s^2, the same for each; in place of the `rate_sd` of the means. A constant
        in all of it goes into the biases.

    Raises
    ------
    EstimateError
        If the positions do not determine the biases, or two sets of biases fit alike.
    """
    for mean in means:
        check_gravity(mean)
    known = _known(len(means), gyro_bias_sd, latitude, turns, turn_sd)
    factor = None if rate_covariance is None else _factor(rate_covariance)
    problem = _Problem(tuple(means), *known, _reference_axes(means, common=turns is not None), factor)
    inputs, moves = np.append(problem.inputs(), np.zeros(3)), problem.moves(accelerometer_bias_sd)
    solution, ratio = _solve(problem, inputs)
    values, sd = propagated(lambda moved: _outputs(problem, moved, solution), inputs, moves)
    notes = [] if accelerometer_bias_sd else ["accelerometer biases are taken as zero"]
    notes += [] if factor is None else ["the positions are weighed by the noise model of the gyros"]
    if ratio > 1.0:
        notes.append(f"residuals are {ratio:.2f} times the noise: standard deviations are scaled up by it")
        sd = sd * ratio
    return TriadFix(
        names=tuple(mean.name for mean in means),
        axes=tuple(axis_directions(values[i : i + 6], sd[i : i + 6]) for i in range(4, len(values), 6)),
        latitude=values[3],
        latitude_sd=sd[3],
        bias=values[:3] * EARTH_RATE,
        bias_sd=sd[:3] * EARTH_RATE,
        notes=tuple(notes),
    )


@dataclass(frozen=True, slots=True)
class _Problem:
    """Least squares for ``x = (bias / Omega, latitude, heading of each position)``; all rates in units of Omega.

    What is known beforehand is linear: ``known @ x = value`` within ``known_sd``. The inputs are one vector: rates,
    specific forces, known values, and the three accelerometer biases.
    """

    means: tuple[StaticMean, ...]
    known: Array  #: shape (k, 4 + n_positions)
    known_value: Array  #: shape (k,)
    known_sd: Array  #: shape (k,)
    reference: tuple[int, ...]  #: in each position the body axis whose azimuth is the heading
    factor: Array | None = None  #: lower, of the covariance of the mean rates of a gyro, (n_positions, n_positions)

    @property
    def whitening(self) -> Array:
        """What makes mean rates of a gyro independent, sd 1, shape (n_positions, n_positions).

        Without a covariance one standard deviation serves for all mean rates: gyros of a triad are of a kind.
        """
        if self.factor is not None:
            return np.asarray(np.linalg.inv(self.factor))
        noise = max(float(np.sqrt(np.mean([mean.rate_sd**2 for mean in self.means]))) / EARTH_RATE, _LEAST_NOISE)
        return np.eye(len(self.means)) / noise

    def inputs(self) -> Array:
        """Return the inputs but for the accelerometer biases."""
        rate, force = [mean.rate / EARTH_RATE for mean in self.means], [mean.specific_force for mean in self.means]
        return np.concatenate([*rate, *force, self.known_value])

    def moves(self, accelerometer_bias_sd: float) -> Array:
        """Return independent moves of all inputs of one standard deviation, as `propagated` takes them."""
        rate_sd = np.concatenate([mean.rate_sd for mean in self.means]) / EARTH_RATE
        rates = np.diag(rate_sd) if self.factor is None else np.kron(self.factor, np.eye(3)).T
        others = [*(mean.specific_force_sd for mean in self.means), self.known_sd, np.full(3, accelerometer_bias_sd)]
        return np.asarray(block_diag(rates, np.diag(np.concatenate(others))))

    def split(self, inputs: Array) -> tuple[Array, Level, Array]:
        """Return rates (n_positions, 3), level directions of each position, known values."""
        n = 3 * len(self.means)
        up = inputs[n : 2 * n].reshape(-1, 3) - inputs[-3:]
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        axis = np.eye(3)[list(self.reference)]
        ahead = axis - np.sum(axis * up, axis=1, keepdims=True) * up
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        return inputs[:n].reshape(-1, 3), (ahead, np.cross(ahead, up), up), inputs[2 * n : -3]

    def equations(self, inputs: Array) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
        """Return the whitened residuals, and their Jacobian, as functions of x."""
        rate, level, value = self.split(inputs)
        known_sd = np.maximum(self.known_sd, 1e-7)
        n, white = len(rate), self.whitening

        def residuals(x: Array) -> Array:
            misfit = x[:3] + _earth(level, x[3], x[4:]) - rate
            return np.concatenate([(white @ misfit).ravel(), (self.known @ x - value) / known_sd])

        def jacobian(x: Array) -> Array:
            by_x = np.zeros((n, 3, 4 + n))
            by_x[:, :, :3] = np.eye(3)
            by_x[:, :, 3] = _earth(level, x[3] + math.pi / 2.0, x[4:])
            by_x[range(n), :, range(4, 4 + n)] = math.cos(x[3]) * _north(level, x[4:] + math.pi / 2.0)
            return np.vstack([(white @ by_x.reshape(n, -1)).reshape(3 * n, -1), self.known / known_sd[:, np.newaxis]])

        return residuals, jacobian

    def fit(self, inputs: Array, start: Array) -> tuple[Array, float, Array]:
        """Return x, chi square and Jacobian of the least squares that begins at `start`."""
        residuals, jacobian = self.equations(inputs)
        found = least_squares(residuals, start, jacobian, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12)
        return found.x, 2.0 * float(found.cost), found.jac

    def refitted(self, inputs: Array, start: Array) -> Array:
        """Return x for inputs a little off those that gave `start`, by Gauss-Newton: many times faster than `fit`."""
        residuals, jacobian = self.equations(inputs)
        x = start.copy()
        for _ in range(_STEPS):
            step = np.linalg.lstsq(jacobian(x), residuals(x), rcond=None)[0]
            x -= step
            if np.max(np.abs(step)) < _CONVERGED:
                break
        return x

    def starts(self, inputs: Array) -> list[Array]:
        """Return where to begin: no bias, and biases around the mean rate, with the headings these would give."""
        rate, (ahead, right, up), _ = self.split(inputs)
        centre = rate.mean(axis=0)
        starts = []
        for bias in [np.zeros(3), centre, *(centre + sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))]:
            vertical = np.mean(np.sum((rate - bias) * up, axis=1))
            headings = np.arctan2(-np.sum((rate - bias) * right, axis=1), np.sum((rate - bias) * ahead, axis=1))
            starts.append(np.array([*bias, math.asin(np.clip(vertical, -0.98, 0.98)), *headings]))
        return starts


def _known(
    n_positions: int, gyro_bias_sd: float | None, latitude: float | None, turns: ArrayLike | None, turn_sd: float
) -> tuple[Array, Array, Array]:
    """Return design, values and standard deviations of what is known beforehand."""
    unknowns = np.eye(4 + n_positions)
    rows: list[tuple[Array, float, float]] = []
    if gyro_bias_sd is not None:
        rows += [(row, 0.0, gyro_bias_sd / EARTH_RATE) for row in unknowns[:3]]
    if latitude is not None:
        rows.append((unknowns[3], latitude, 0.0))
    if turns is not None:
        turned = np.asarray(turns, dtype=np.float64)
        if turned.shape != (n_positions,):
            raise ValueError(f"turns has shape {turned.shape}, expected one turn for each of {n_positions} positions")
        rows += [(unknowns[4 + p] - unknowns[4], turned[p] - turned[0], turn_sd) for p in range(1, n_positions)]
    design = np.array([row for row, _, _ in rows]).reshape(-1, 4 + n_positions)
    return design, np.array([value for _, value, _ in rows]), np.array([sd for _, _, sd in rows])


def _factor(rate_covariance: Array) -> Array:
    """Return the lower factor of the covariance in units of Omega."""
    covariance = rate_covariance / EARTH_RATE**2
    return np.asarray(np.linalg.cholesky(covariance + _LEAST_NOISE**2 * np.eye(len(covariance))))


def _reference_axes(means: Sequence[StaticMean], *, common: bool) -> tuple[int, ...]:
    """Return for each position a body axis far from vertical; the same one for all if `common`."""
    vertical = np.array([np.abs(unit(mean.specific_force)) for mean in means])
    axes = np.argmin(np.broadcast_to(vertical.max(axis=0), vertical.shape) if common else vertical, axis=1)
    return tuple(int(axis) for axis in axes)


def _solve(problem: _Problem, inputs: Array) -> tuple[Array, float]:
    """Return x and the Birge ratio; raise EstimateError if the data leave x open."""
    fits = sorted((problem.fit(inputs, start) for start in problem.starts(inputs)), key=lambda fit: fit[1])
    alike = sorted((fit for fit in fits if fit[1] < fits[0][1] + 9.0), key=lambda fit: np.linalg.norm(fit[0][:3]))
    x, chi_square, jacobian = alike[0]
    singular = np.linalg.svd(jacobian, compute_uv=False)
    if singular[-1] < max(1.0 / HEADING_SD_MAX, 1e-9 * singular[0]):
        raise EstimateError(
            "the positions do not determine gyro biases, latitude and headings: turn the body about a level axis, "
            "or give the turns about the vertical, the latitude or the sd of the gyro biases"
        )
    sizes = np.array([np.linalg.norm(fit[0][:3]) for fit in alike])
    apart = np.array([np.linalg.norm(fit[0][:3] - x[:3]) for fit in alike]) > 0.05
    if np.any(apart & (sizes < 3.0 * sizes[0])):
        other = sizes[apart].min() * EARTH_RATE / DPH
        raise EstimateError(
            f"gyro biases of {sizes[0] * EARTH_RATE / DPH:.1f} and of {other:.1f} deg/h fit alike: "
            "measure one more position, or give the turns, the latitude or the sd of the gyro biases"
        )
    x = x.copy()
    if math.cos(x[3]) < 0.0:
        x[3:] = [math.pi - x[3], *(x[4:] + math.pi)]
    x[3] = math.remainder(x[3], 2.0 * math.pi)
    freedom = max(len(jacobian) - len(x), 1)
    return x, math.sqrt(chi_square / freedom)


def _outputs(problem: _Problem, inputs: Array, start: Array) -> Array:
    """Return biases / Omega, latitude and for each position azimuth and elevation of x, y, z."""
    x = problem.refitted(inputs, start)
    _, level, _ = problem.split(inputs)
    axes = [directions(north, up) for north, up in zip(_north(level, x[4:]), level[2], strict=True)]
    return np.concatenate([x[:4], *axes])


def _north(level: Level, heading: Array) -> Array:
    """Return north in the body frame of each position, with the level reference axis at azimuth `heading`."""
    return np.asarray(np.cos(heading)[:, np.newaxis] * level[0] - np.sin(heading)[:, np.newaxis] * level[1])


def _earth(level: Level, latitude: float, heading: Array) -> Array:
    """Return the earth's rotation / Omega in the body frame of each position."""
    return math.cos(latitude) * _north(level, heading) + math.sin(latitude) * level[2]
