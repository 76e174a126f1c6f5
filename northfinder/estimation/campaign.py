"""Statistics of repeated measurements: mean, scatter within and between turn-ons, and whether it is as stated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from northfinder.estimation.quantiles import chi_square, chi_square_tail, variance_ratio_tail

Array = NDArray[np.float64]

_NO_GAP = 1e-3  # a gap that is none, in whatever unit of days, hours or seconds


def circular_mean(angles: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Return the weighted mean of angles that lie within half a turn, rad, in [-pi, pi].

    It is the arithmetic mean of their deviations from the mean direction, so the 0 of azimuth does no harm.
    """
    values = np.asarray(angles, dtype=np.float64)
    weight = np.ones(values.shape) if weights is None else np.asarray(weights, dtype=np.float64)
    direction = math.atan2(float(weight @ np.sin(values)), float(weight @ np.cos(values)))
    mean = direction + float(weight @ deviations(values, direction)) / float(np.sum(weight))
    return math.remainder(mean, 2.0 * math.pi)


def deviations(angles: ArrayLike, mean: float) -> Array:
    """Return how far each of `angles` is from `mean`, the short way round, rad."""
    difference = np.asarray(angles, dtype=np.float64) - mean
    return np.asarray(np.arctan2(np.sin(difference), np.cos(difference)))


@dataclass(frozen=True, slots=True)
class Scatter:
    """Mean and standard deviation of single values."""

    n: int
    mean: float
    sd: float | None  #: of one value, n - 1 degrees of freedom; None of a single one


def scatter(values: ArrayLike, *, circular: bool = False) -> Scatter:
    """Return mean and sd of at least one value; `circular` for angles in rad, whose mean is in [0, 2 pi) then."""
    array = np.asarray(values, dtype=np.float64)
    mean = circular_mean(array) if circular else float(np.mean(array))
    off = deviations(array, mean) if circular else array - mean
    sd = math.sqrt(float(off @ off) / (array.size - 1)) if array.size > 1 else None
    return Scatter(array.size, mean % (2.0 * math.pi) if circular else mean, sd)


@dataclass(frozen=True, slots=True, kw_only=True)
class TurnOnScatter:
    """Scatter split by turn-ons (one-way analysis of variance)."""

    n_turn_ons: int
    within: float | None  #: sd of one value about the mean of its turn-on; None if no turn-on has two values
    between: float | None  #: sd of the turn-ons' true values about theirs, 0 if none shows; None with one turn-on
    probability: float | None  #: of so large a difference of the turn-ons' means if there were none


def turn_on_scatter(off: ArrayLike, turn_on: ArrayLike) -> TurnOnScatter:
    """Return the scatter within and between turn-ons.

    Parameters
    ----------
    off : (n,) array
        Values, or of angles the deviations from their mean.
    turn_on : (n,) int array
        To which turn-on each belongs.
    """
    values = np.asarray(off, dtype=np.float64)
    _, group, counts = np.unique(np.asarray(turn_on), return_inverse=True, return_counts=True)
    means = np.bincount(group, values) / counts
    n, n_groups = values.size, counts.size
    dof = n - n_groups
    within = float(np.sum((values - means[group]) ** 2)) / dof if dof else None
    if n_groups < 2:
        return TurnOnScatter(n_turn_ons=n_groups, within=_root(within), between=None, probability=None)
    mean_square = float(np.sum(counts * (means - np.mean(values)) ** 2)) / (n_groups - 1)
    if within is None:  # one value a turn-on: what there is, is between them
        return TurnOnScatter(n_turn_ons=n_groups, within=None, between=_root(mean_square), probability=None)
    size = (n - float(np.sum(counts**2)) / n) / (n_groups - 1)
    between = _root(max(mean_square - within, 0.0) / size)
    probability = variance_ratio_tail(mean_square / within, n_groups - 1, dof) if within else 0.0
    return TurnOnScatter(n_turn_ons=n_groups, within=_root(within), between=between, probability=probability)


def _root(variance: float | None) -> float | None:
    return None if variance is None else math.sqrt(variance)


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """Whether values scatter as their stated standard deviations say."""

    rms: float  #: of the normalised errors, 1 if the statements are honest
    chi2: float
    dof: int
    probability: float  #: of a chi square at least as large if they are
    low: float  #: bounds that an honest rms keeps with 95 %
    high: float


def consistency(
    off: ArrayLike, sd: ArrayLike, group: ArrayLike | None = None, *, known: bool = False
) -> Consistency | None:
    """Return whether `off` is as large as `sd` says; None if nothing is left to judge by.

    Parameters
    ----------
    off, sd : (n,) arrays
        Values (of angles, deviations from any common direction near them) and their stated standard deviations.
    group : (n,) int array, optional
        Judge about the weighted mean of each group, such as a turn-on, rather than of all.
    known : bool
        `off` are errors against a known truth: no mean is taken off.
    """
    values, sds = np.asarray(off, dtype=np.float64), np.asarray(sd, dtype=np.float64)
    dof = values.size
    if not known:
        groups = np.zeros(dof, dtype=np.int64) if group is None else np.unique(group, return_inverse=True)[1]
        weights = 1.0 / sds**2
        means = np.bincount(groups, weights * values) / np.bincount(groups, weights)
        values = values - means[groups]
        dof -= means.size
    if dof < 1:
        return None
    chi2 = float(np.sum((values / sds) ** 2))
    low, high = (math.sqrt(chi_square(tail, dof) / dof) for tail in (0.975, 0.025))
    return Consistency(
        rms=math.sqrt(chi2 / dof), chi2=chi2, dof=dof, probability=chi_square_tail(chi2, dof), low=low, high=high
    )


def longest_gap(gaps: ArrayLike, *, least: float | None = None) -> int | None:
    """Return after which measurement the pause of a campaign came, None if there was none.

    Parameters
    ----------
    gaps : (n - 1,) array
        Time from the end of each measurement to the start of the next.
    least : float, optional
        The first gap at least this long is the pause; if not given, the longest, if it is ten times the median gap.
    """
    times = np.asarray(gaps, dtype=np.float64)
    if times.size == 0:
        return None
    if least is not None:
        found = np.flatnonzero(times >= least)
        return int(found[0]) if found.size else None
    index = int(np.argmax(times))
    others = np.delete(times, index)
    return index if others.size and times[index] > 10.0 * max(float(np.median(others)), _NO_GAP) else None
