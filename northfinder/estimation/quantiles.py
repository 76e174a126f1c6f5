"""Quantiles and tails of Student's t, chi-square and Fisher's F.

From `scipy.special`, because `scipy.stats`, which has them too, takes most of a second to import.
"""

from __future__ import annotations

import math

from scipy import special


def student_t(tail: float, dof: float) -> float:
    """Return what Student's t with `dof` degrees of freedom, infinite for a normal, exceeds with probability `tail`.

    >>> round(student_t(0.025, math.inf), 3), round(student_t(0.025, 4), 3)
    (1.96, 2.776)
    """
    return float(-special.ndtri(tail) if math.isinf(dof) else -special.stdtrit(dof, tail))


def chi_square(tail: float, dof: int) -> float:
    """Return what chi-square with `dof` degrees of freedom exceeds with probability `tail`.

    >>> round(chi_square(0.05, 3), 3), round(chi_square(0.95, 3), 3)
    (7.815, 0.352)
    """
    return float(special.chdtri(dof, tail))


def chi_square_tail(value: float, dof: int) -> float:
    """Return the probability that chi-square with `dof` degrees of freedom exceeds `value`.

    >>> round(chi_square_tail(7.815, 3), 3)
    0.05
    """
    return float(special.chdtrc(dof, value))


def variance_ratio_tail(ratio: float, dof: int, dof_within: int) -> float:
    """Return the probability that Fisher's F with `dof` and `dof_within` degrees of freedom exceeds `ratio`.

    >>> round(variance_ratio_tail(4.26, 2, 9), 3)
    0.05
    """
    return float(special.fdtrc(dof, dof_within, ratio))
