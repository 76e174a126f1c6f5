"""How small errors travel: from the means through the estimator's own weights to N, E, V, and on to the angles.

The weights are those that `estimate` used, so what is propagated here adds up to the standard deviations it states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from northfinder.estimation.checks import positions
from northfinder.estimation.fix import Fix, Known
from northfinder.estimation.geometry import rates_jacobian, sensitivity
from northfinder.estimation.least_squares import MEASURES_VERTICAL, Weights, fit_best, known_bias
from northfinder.estimation.linear import Design, Drift, LinearFit, build_design, least_squares
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.whitening import whiten
from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]

#: More means than these are averaged to as many longer ones: the budget of a day is then some per cent too large.
MANY = 4000
_STEP = 1e-3  # relative change of a noise variance for its derivative; the error is its square
_ANGLE_STEP = 1e-4  # rad, for the derivative of the input axis by the stage angles


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gains:
    """How azimuth and latitude (rows) follow the rates N, E, V and what was known ahead."""

    rates: Array  #: (2, 3), s
    latitude: Array  #: (2,), by the known latitude
    scale_factor: Array  #: (2,), rad, by the known scale factor


def gains(fix: Fix, known: Known, *, azimuth: float, vertical: bool) -> Gains:
    """Return the gains of the least squares with which `estimate` turned rates into angles.

    Parameters
    ----------
    fix : Fix
    known : Known
        As given to `estimate`.
    azimuth : float
        The azimuth as `estimate` gave it, rad.
    vertical : bool
        Whether the positions measured V.
    """
    north, east, _ = fix.rates
    if not vertical or fix.latitude is None or fix.scale_factor is None:
        by_rates = np.array([[-east, north, 0.0], [0.0, 0.0, 0.0]]) / (north**2 + east**2)
        return Gains(rates=by_rates, latitude=np.array([0.0, 1.0]), scale_factor=np.zeros(2))
    prior = {1: (known.latitude, known.latitude_sd), 2: (known.scale_factor, known.scale_factor_sd)}
    given = {index: sd for index, (value, sd) in prior.items() if value is not None}
    free = [index for index in range(3) if given.get(index, 1.0) > 0.0]
    jacobian = rates_jacobian(azimuth, fix.latitude, fix.scale_factor)[:, free]
    cov = fix.rates_covariance + (1e-12 * EARTH_RATE) ** 2 * np.eye(3)
    weighted = np.linalg.solve(cov, jacobian).T
    weights = {index: 1.0 / sd**2 for index, sd in given.items() if sd > 0.0}
    information = weighted @ jacobian + np.diag([weights.get(index, 0.0) for index in free])
    by_rates, by_prior = np.zeros((3, 3)), np.zeros((3, 3))
    by_rates[free] = np.linalg.solve(information, weighted)
    by_prior[np.ix_(free, free)] = np.linalg.inv(information)
    by_prior *= [weights.get(index, 0.0) for index in range(3)]
    return Gains(rates=by_rates[:2], latitude=by_prior[:2, 1], scale_factor=by_prior[:2, 2])


@dataclass(frozen=True, slots=True, eq=False)
class Propagation:
    """The estimator's linear map from the rows of its design to N, E and V."""

    design: Design
    fit: LinearFit
    noise: NoiseModel | None
    weights: Weights
    known: Known
    vertical: bool  #: whether V was measured, not assumed

    @classmethod
    def of(
        cls, means: RateMeans, *, noise: NoiseModel | None, known: Known, drift: Drift, weights: Weights
    ) -> Propagation:
        """Return that of `estimate` with the same arguments; of longer means where there are more than MANY.

        Raises EstimateError as it does.
        """
        means = _at_most(means, MANY)
        design = build_design(means, drift, bias_known=known.bias_sd is not None)
        vertical = design.vertical >= MEASURES_VERTICAL
        if 0.0 < design.vertical < MEASURES_VERTICAL:
            _, vertical = fit_best(design, noise, weights, known)
        fit = _solved(design, noise, weights, known, vertical)
        return cls(design, fit, noise, weights, known, vertical)

    def through(self, columns: Array) -> Array:
        """Return what errors of the mean rates, (n, n_axes, m), make of N, E and V, shape (3, m)."""
        n, n_axes, m = columns.shape
        if self.weights == "generalised" and self.noise is not None:
            columns = whiten(self.noise, self.design.means, columns.reshape(n, -1)).reshape(n, n_axes, m)
        return np.asarray(self.fit.inverse[:3] @ columns.swapaxes(0, 1).reshape(-1, m))

    def noise_covariances(self) -> dict[str, Array]:
        """Return the covariance of N, E and V, (3, 3), that each kind of noise in the model brings.

        With generalised weights ``P = (A^T C^-1 A)^-1`` and ``C = sum c_k C_k``, the part of kind k through the actual
        weights ``P A^T C^-1`` is ``c_k dP/dc_k``: the derivative needs whitening alone, at a cost linear in time.
        """
        if self.noise is None:
            return {}
        kinds = {field.name: getattr(self.noise, field.name) for field in fields(self.noise)}
        return {
            kind: self._covariance_of(kind, coefficient) for kind, coefficient in kinds.items() if coefficient > 0.0
        }

    def _covariance_of(self, kind: str, coefficient: float) -> Array:
        if self.noise is None:
            raise ValueError("there is no noise model to propagate")
        if self.weights == "generalised":
            ends = []
            for step in (_STEP, -_STEP):
                changed = replace(self.noise, **{kind: coefficient * (1.0 + step) ** 0.5})
                solved = _solved(self.design, changed, self.weights, self.known, self.vertical)
                ends.append((solved.inverse @ solved.inverse.T + solved.assumed)[:3, :3])
            return np.asarray((ends[0] - ends[1]) / (2.0 * _STEP))
        alone = NoiseModel(**{kind: coefficient}).covariance(self.design.means)
        n = len(alone)
        blocks = (self.fit.inverse[:3, i : i + n] for i in range(0, self.fit.inverse.shape[1], n))
        return np.asarray(sum(block @ alone @ block.T for block in blocks))

    def without_drift(self) -> Array:
        """Return ``(A^T A)^-1`` of N, E and V, shape (3, 3), for a bias that does not drift, ordinary weights."""
        design = build_design(self.design.means, "constant")
        inverse = _solved(design, None, "ordinary", Known(), self.vertical).inverse[:3]
        return np.asarray(inverse @ inverse.T)

    def by_assumed_vertical(self) -> Array:
        """Return the derivative of N, E and V by the V that is assumed where it is not measured, shape (3,)."""
        return self.fit.by_vertical[:3]

    def by_known_bias(self) -> Array:
        """Return the derivative of N, E and V by the known bias of each axis, shape (3, n_axes)."""
        return self.fit.by_bias[:3]

    def by_stage_angles(self, rates: Array, of: Sequence[str] = ("azimuth", "elevation")) -> Array:
        """Return what one radian of error of each stage angle at each position makes of N, E and V, shape (3, m).

        The error of a stage belongs to the position: it is the same at each visit.
        """
        means = self.design.means
        visits = positions(self.design.sensitivity.reshape(means.n, -1))
        columns = []
        for angle in of:
            ends = []
            for step in (_ANGLE_STEP, -_ANGLE_STEP):
                angles = {"azimuth": means.azimuth, "elevation": means.elevation}
                angles[angle] = angles[angle] + step
                ends.append(sensitivity(**angles, tilt=means.tilt, n_axes=means.n_axes) @ rates)
            change = (ends[0] - ends[1]) / (2.0 * _ANGLE_STEP)
            columns += [change * np.isin(np.arange(means.n), rows)[:, np.newaxis] for rows in visits]
        return self.through(np.stack(columns, axis=2))

    def by_misalignment(self, rates: Array) -> Array:
        """Return what one radian of each misalignment of each input axis makes of N, E and V, shape (3, m).

        An axis leans towards the two axes of the stage's head that it should be square to.
        """
        means = self.design.means
        felt = sensitivity(means.azimuth, means.elevation, means.tilt, n_axes=3) @ rates
        columns = []
        for axis in range(means.n_axes):
            for toward in {0, 1, 2} - {axis}:
                column = np.zeros((means.n, means.n_axes))
                column[:, axis] = felt[:, toward]
                columns.append(column)
        return self.through(np.stack(columns, axis=2))


def _solved(
    design: Design,
    noise: NoiseModel | None,
    weights: Weights,
    known: Known,
    vertical: bool,  # noqa: FBT001  # private
) -> LinearFit:
    assumed = None if vertical else (0.0, 0.0)
    if noise is None or weights == "ordinary":
        rows = (design.matrix, design.means.rate.T.ravel())
        return least_squares(*rows, assumed, known_bias(design, known, noise))
    return least_squares(*design.whitened(noise, design.means.rate), assumed, known_bias(design, known))


def _at_most(means: RateMeans, n: int) -> RateMeans:
    """Return the means, neighbours of a dwell averaged so that not many more than `n` are left."""
    together = -(-means.n // n)
    if together == 1:
        return means
    first = np.concatenate([[True], (np.diff(means.dwell) != 0) | (means.gap != 0.0)])
    run = np.cumsum(first) - 1
    place = np.arange(means.n) - np.flatnonzero(first)[run]
    group = np.cumsum(np.concatenate([[0], (np.diff(run) != 0) | (np.diff(place // together) != 0)]))
    parts = {field.name: getattr(means, field.name) for field in fields(means)}
    return RateMeans(**parts | {"dwell": group}).per_dwell()
