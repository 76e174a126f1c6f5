"""Whitening of interval means in one pass over time: the Cholesky factor of the covariance, never formed.

``C = L L^T`` for the covariance of n means costs n^3; a Kalman filter on the state-space model of the same noise
(`noise.components`) gives the rows of ``L^-1 columns`` one by one as its innovations over their standard deviations
(Anderson and Moore, Optimal Filtering, 1979, section 9.3), at a cost linear in n. Least squares of the whitened columns
are the generalised least squares of the original ones.

State: the Gauss-Markov processes, the rate random walk, the ramp's value and slope, the white angle at the last end
point. A step is a gap, then an interval whose mean is observed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import Components, NoiseModel, components, mean_variance

Array = NDArray[np.float64]

#: The filter is kept for so many means at the most, half an hour of seconds; 0.3 kB each.
KEPT_MEANS = 2000


def whiten(noise: NoiseModel, means: RateMeans, columns: Array) -> Array:
    """Return ``L^-1 columns`` with ``L`` the Cholesky factor of ``noise.covariance(means)``.

    Parameters
    ----------
    noise : NoiseModel
        At least one coefficient must be positive.
    means : RateMeans
        The n intervals.
    columns : (n, k) array
        What to whiten: design columns, rates.

    Returns
    -------
    (n, k) array

    Raises
    ------
    ValueError
        The noise model predicts a mean without error, as one that is all zero does.
    """
    model = _StateSpace(noise, components(noise, means))
    state = np.zeros((model.n_states, columns.shape[1]))
    whitened = np.empty(columns.shape)
    of_model = _kept_filter if means.n <= KEPT_MEANS else _filter
    for i, (transition, gain, sd) in enumerate(of_model(model, _timing(means))):
        predicted = transition @ state
        innovation = columns[i] - predicted[0]
        whitened[i] = innovation / sd
        state = predicted[1:] + gain * innovation
    return whitened


#: Gap before a mean, whether it shares an end point with the one before, and its duration, in s.
_Timing = tuple[tuple[float, bool, float], ...]
#: Transition to (mean, state at its end), gain of the mean's innovation, standard deviation of the innovation.
_FilterStep = tuple[Array, Array, float]


def _timing(means: RateMeans) -> _Timing:
    gaps = np.concatenate([[0.0], np.round(means.gap, 9)]).tolist()
    linked = np.concatenate([[True], means.gap == 0.0]).tolist()
    return tuple(zip(gaps, linked, means.duration.tolist(), strict=True))


def _filter(model: _StateSpace, timing: _Timing) -> Iterator[_FilterStep]:
    """Yield the steps of the filter, which do not depend on what was measured; equal intervals share a transition."""
    known = {key: model.step(*key) for key in set(timing)}
    cov = model.initial_covariance()
    for i, key in enumerate(timing):
        transition, process = known[key]
        joint = transition @ cov @ transition.T + process  # of the mean and the state at its end
        variance = joint[0, 0]
        if not variance > 0.0:
            raise ValueError(f"the noise model leaves mean {i} without error: give it a positive coefficient")
        gain = joint[1:, :1] / variance
        cov = joint[1:, 1:] - gain * joint[0, 1:]
        yield transition, gain, variance**0.5


@lru_cache(maxsize=8)
def _kept_filter(model: _StateSpace, timing: _Timing) -> list[_FilterStep]:
    """Return the steps of the filter, kept for the next data with the same timing: another cycle, or another fit."""
    return list(_filter(model, timing))


@dataclass(frozen=True, slots=True)
class _StateSpace:
    noise: NoiseModel
    parts: Components

    @property
    def n_states(self) -> int:
        return len(self.parts.time_constants) + 4

    def initial_covariance(self) -> Array:
        """At the first start: stationary processes, no random walk yet, a slope of unknown size, a fresh end point."""
        stationary = np.full(len(self.parts.time_constants), self.parts.variance)
        rest = np.array([0.0, 0.0, self.noise.rate_ramp**2, self.noise.angle_white_noise**2])
        return np.diag(np.concatenate([stationary, rest]))

    def step(self, gap: float, linked: bool, duration: float) -> tuple[Array, Array]:  # noqa: FBT001  # a key's parts
        """Return (transition, process noise) from the state before the gap to (mean, state at the interval's end)."""
        across, across_noise = self._move(gap)
        white = self.noise.angle_white_noise**2
        across[-1, -1] = float(linked)
        across_noise[-1, -1] = 0.0 if linked else white
        within, within_noise = self._move(duration)
        within[-1, -1] = 0.0
        within_noise[-1, -1] = white
        observe, variance, covariance = self._observe(duration)
        transition = np.vstack([observe, within])
        process = np.zeros((self.n_states + 1, self.n_states + 1))
        process[0, 0] = variance
        process[0, 1:] = process[1:, 0] = covariance
        process[1:, 1:] = within_noise
        return transition @ across, process + transition @ across_noise @ transition.T

    def _move(self, time: float) -> tuple[Array, Array]:
        """Return transition and process noise of the state over `time`, the end point left open."""
        x = time / np.array(self.parts.time_constants)
        transition = np.diag(np.concatenate([np.exp(-x), np.ones(4)]))
        transition[-3, -2] = time  # the ramp's value grows by its slope
        gained = -self.parts.variance * np.expm1(-2.0 * x)
        return transition, np.diag(np.concatenate([gained, [self.parts.rate_random_walk**2 * time, 0.0, 0.0, 0.0]]))

    def _observe(self, duration: float) -> tuple[Array, float, Array]:
        """Return how the mean over an interval follows from the state at its start, and its noise with the end's."""
        tau = np.array(self.parts.time_constants)
        x = duration / tau
        weight = -np.expm1(-x) / x
        walk = self.parts.rate_random_walk**2
        white = self.noise.angle_white_noise**2
        observe = np.concatenate([weight, [1.0, 1.0, duration / 2.0, -1.0 / duration]])
        variance = walk * duration / 3.0 + self.parts.angle_random_walk**2 / duration + white / duration**2
        variance += float(np.sum(self.parts.variance * (mean_variance(x) - weight**2)))
        covariance = np.concatenate([self.parts.variance * weight**2 * x, [walk * duration / 2.0, 0.0, 0.0]])
        return observe, variance, np.append(covariance, white / duration)
