"""Named checks of an estimate: a value that ought to be small, its standard deviation, and the limit it must keep.

Each limit is passed by chance once in a thousand good measurements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from northfinder.estimation.geometry import sensitivity
from northfinder.estimation.means import RateMeans
from northfinder.estimation.quantiles import chi_square, student_t
from northfinder.units import DPH

Array = NDArray[np.float64]

FALSE_ALARM = 1e-3
#: The horizontal earth rate must exceed this many of its standard deviations; at the limit the azimuth's is 19 deg.
HORIZONTAL_LIMIT = 3.0
#: Input axes closer than this, rad, stand in the same position.
SAME_POSITION = math.radians(1.0)


@dataclass(frozen=True, slots=True)
class Check:
    """One check: whether `value` keeps within `limit`."""

    name: str
    value: float  #: in `unit`
    sd: float  #: standard deviation of the value, same unit
    limit: float  #: same unit
    unit: str  #: "rad/s", "rad" or "1"
    passed: bool
    sentence: str  #: what it means, for the operator
    decisive: bool = True  #: whether a failure makes the fix untrustworthy, rather than only less sure than expected


def horizontal_rate(nev: Array, covariance: Array) -> Check:
    """Return whether the horizontal earth rate stands out of its noise: without it there is no azimuth."""
    value = math.hypot(nev[0], nev[1])
    sd = math.sqrt(max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0))
    limit = HORIZONTAL_LIMIT * sd
    passed = value > limit
    verdict = "stands out of its noise" if passed else "is not distinguishable from zero"
    figures = f"{value / DPH:.3g} deg/h with a standard deviation of {sd / DPH:.2g} deg/h"
    return Check(
        "horizontal rate", value, sd, limit, "rad/s", passed, f"the horizontal earth rate {verdict}: {figures}"
    )


def residuals(name: str, chi2: float, dof: int) -> Check:
    """Return whether the residuals are as large as the noise model says, neither larger nor smaller.

    Not decisive: where they are larger the standard deviations of the fix are widened.
    """
    value = chi2 / dof
    high, low = (chi_square(tail, dof) / dof for tail in (FALSE_ALARM / 2.0, 1.0 - FALSE_ALARM / 2.0))
    passed = low <= value <= high
    verdict = "fits" if passed else "does not fit"
    sentence = f"the noise model {verdict}: {name} are {math.sqrt(value):.3g} times what it predicts"
    return Check(name, value, math.sqrt(2.0 / dof), high, "1", passed, sentence, decisive=False)


def agreement(name: str, difference: float, sd: float, unit: str, sd_dof: float) -> Check:
    """Return whether an estimate agrees with what was known ahead; `unit` is "rad", "rad/s" or "1"."""
    limit = student_t(FALSE_ALARM / 2.0, sd_dof) * sd
    passed = abs(difference) <= limit
    factor, shown = {"rad": (math.degrees(1.0), " deg"), "rad/s": (1.0 / DPH, " deg/h")}.get(unit, (1.0, ""))
    verdict = "agrees" if passed else "does not agree"
    figures = f"it differs by {difference * factor:.3g}{shown}, limit {limit * factor:.2g}{shown}"
    sentence = f"the measured {name} {verdict} with the known one: {figures}"
    return Check(name, difference, sd, limit, unit, passed, sentence)


def closures(means: RateMeans, covariance: Array, sd_dof: float) -> list[Check]:
    """Return the checks that need no model of the earth: opposite positions add up alike, repeated ones agree.

    Parameters
    ----------
    means : RateMeans
        One mean a dwell, their rates the residuals of the fit, in which a drift is already taken out.
    covariance : (n, n) array
        Of those means for one axis, rad^2/s^2.
    sd_dof : float
        Degrees of freedom behind `covariance`.
    """
    axes = sensitivity(means.azimuth, means.elevation, means.tilt, n_axes=means.n_axes)
    found: dict[str, list[tuple[float, float]]] = {"pair sums": [], "repeated positions": []}
    for axis in range(means.n_axes):
        groups = positions(axes[:, axis])
        contrasts = {"pair sums": _pair_sums(groups, axes[:, axis]), "repeated positions": _repeats(groups)}
        for name, of_kind in contrasts.items():
            found[name] += [contrast.applied(means.rate[:, axis], covariance) for contrast in of_kind]
    return [_closure(name, values, sd_dof) for name, values in found.items() if values]


@dataclass(frozen=True, slots=True, eq=False)
class _Contrast:
    """What to multiply a few of the dwell means by to get a figure that ought to be zero."""

    dwells: list[int]
    weights: Array

    def applied(self, rate: Array, covariance: Array) -> tuple[float, float]:
        """Return the figure and its standard deviation."""
        variance = self.weights @ covariance[np.ix_(self.dwells, self.dwells)] @ self.weights
        return float(self.weights @ rate[self.dwells]), math.sqrt(max(float(variance), 0.0))


def positions(axes: Array) -> list[list[int]]:
    """Return the rows of each position, the positions in the order they were first taken.

    A row holds the components of one input axis, or of several one after the other.
    """
    groups: list[list[int]] = []
    for i, axis in enumerate(axes):
        same = [group for group in groups if np.linalg.norm(axes[group[0]] - axis) < SAME_POSITION]
        if same:
            same[0].append(i)
        else:
            groups.append([i])
    return groups


def _pair_sums(groups: list[list[int]], axes: Array) -> list[_Contrast]:
    """Return the differences between the half sums of opposite positions."""
    opposite = [(a, b) for a, b in combinations(groups, 2) if np.linalg.norm(axes[a[0]] + axes[b[0]]) < SAME_POSITION]
    halves = [(a + b, np.repeat([0.5 / len(a), 0.5 / len(b)], [len(a), len(b)])) for a, b in opposite]
    return [
        _Contrast(first + second, np.concatenate([-of_first, of_second]))
        for (first, of_first), (second, of_second) in combinations(halves, 2)
    ]


def _repeats(groups: list[list[int]]) -> list[_Contrast]:
    """Return the changes from the first to each later visit of a position."""
    return [_Contrast([group[0], later], np.array([-1.0, 1.0])) for group in groups for later in group[1:]]


def _closure(name: str, values: list[tuple[float, float]], sd_dof: float) -> Check:
    factor = student_t(FALSE_ALARM / 2.0 / len(values), sd_dof)
    value, sd = max(values, key=lambda pair: abs(pair[0]) - factor * pair[1])
    passed = abs(value) <= factor * sd
    verdict = "agree" if passed else "do not agree"
    sentence = f"{name} {verdict}: largest difference {value / DPH:.3g} deg/h, limit {factor * sd / DPH:.2g} deg/h"
    return Check(name, value, sd, factor * sd, "rad/s", passed, sentence, decisive=False)
