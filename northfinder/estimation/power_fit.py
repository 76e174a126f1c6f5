"""Maximum likelihood for powers that are a sum of known spectra with unknown, non-negative weights.

A mean of `dof` squares of independent Gaussian numbers has a gamma distribution. Minus twice its log likelihood is
``dof (ln v + power/v)`` with the expected power v, and Fisher scoring for v linear in the weights is a least-squares
fit with the weights ``dof/v^2`` (McCullagh and Nelder, Generalized Linear Models, 1989, section 8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import brentq, nnls

Array = NDArray[np.float64]
Kinds = NDArray[np.int64]

#: Twice the gain in log likelihood from which a weight is supported: it is then about one sd away from zero.
SUPPORTED = 1.0
#: Twice the loss in log likelihood at the 95 % upper bound of a weight that cannot be negative.
EXCLUDED = float(stats.chi2.ppf(0.90, 1))
_MAX_STEPS = 200


@dataclass(frozen=True, slots=True, eq=False)
class PowerFit:
    """Powers of b bands, to be explained by k spectra."""

    power: Array  #: mean square of each band, shape (b,)
    dof: Array  #: its degrees of freedom, shape (b,)
    spectra: Array  #: power for weights of one, shape (b, k), of the order of `power`

    def loss(self, weights: Array) -> float:
        """Return minus twice the log likelihood of `weights`, shape (k,), but for a constant."""
        variance = self.spectra @ weights
        if np.any(variance <= 0.0):
            return math.inf
        return float(np.sum(self.dof * (np.log(variance) + self.power / variance)))

    def maximum(self, start: Array, free: Kinds | None = None) -> Array:
        """Return the most likely weights where only those at the indices `free`, all by default, may change.

        `start` must explain some power in every band; the others keep their value in it.
        """
        index = np.arange(start.size) if free is None else free
        weights, best = start, self.loss(start)
        fixed = np.where(np.isin(np.arange(start.size), index), 0.0, start)
        rest = self.power - self.spectra @ fixed
        for _ in range(_MAX_STEPS):
            root = np.sqrt(self.dof) / (self.spectra @ weights)
            target = fixed.copy()
            target[index], _ = nnls(self.spectra[:, index] * root[:, np.newaxis], rest * root)
            step = target - weights
            found = self.loss(weights + step)
            while found > best and np.max(np.abs(step)) > 1e-12:
                step = step / 2.0
                found = self.loss(weights + step)
            if not found < best - 1e-9:
                break
            weights, best = weights + step, found
        return weights

    def reduced(self, weights: Array) -> Array:
        """Return the most likely weights after dropping, the least supported first, those the data do not support."""
        while np.count_nonzero(weights) > 1:
            kept = np.flatnonzero(weights)
            without = [self._without(weights, kind, kept) for kind in kept.tolist()]
            losses = [self.loss(each) for each in without]
            least = int(np.argmin(losses))
            if losses[least] - self.loss(weights) > SUPPORTED:
                break
            weights = without[least]
        return weights

    def _without(self, weights: Array, kind: int, kept: Kinds) -> Array:
        start = np.where(np.arange(weights.size) == kind, 0.0, weights)
        return self.maximum(start, kept[kept != kind])

    def sds(self, weights: Array) -> Array:
        """Return the sd of each weight from the Fisher information of those that are not zero; zero for the others."""
        kept = np.flatnonzero(weights)
        rows = self.spectra[:, kept] * (np.sqrt(0.5 * self.dof) / (self.spectra @ weights))[:, np.newaxis]
        sds = np.zeros(weights.size)
        sds[kept] = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
        return sds

    def upper_bound(self, weights: Array, kind: int) -> float:
        """Return the weight of `kind`, zero in the most likely `weights`, at which the data speak against it (95 %)."""
        others = np.delete(np.arange(weights.size), kind)
        allowed = self.loss(weights) + EXCLUDED

        def surplus(weight: float) -> float:
            start = weights.copy()
            start[kind] = weight
            return self.loss(self.maximum(start, others)) - allowed

        high = 1e-6
        while surplus(high) < 0.0:
            high *= 4.0
        return float(brentq(surplus, 0.0, high, rtol=1e-4))
