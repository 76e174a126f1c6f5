"""The published closed forms on the six-position cyclogram (docs/method.md, section 2).

Positions 1 to 4 hold the input axis level at stage azimuths 0, 90, 180 and 270 deg, 5 up, 6 down. Only the first visit
of a position counts, as published: later ones are there to show the drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from northfinder.errors import EstimateError
from northfinder.estimation import checks
from northfinder.estimation.geometry import angles, sensitivity
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel
from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]

#: Input axes of positions 1 to 6 in the level frame of `geometry.sensitivity`.
_POSITIONS = {
    "U1 (stage azimuth 0 deg)": (1.0, 0.0, 0.0),
    "U2 (stage azimuth 90 deg)": (0.0, -1.0, 0.0),
    "U3 (stage azimuth 180 deg)": (-1.0, 0.0, 0.0),
    "U4 (stage azimuth 270 deg)": (0.0, 1.0, 0.0),
    "U5 (input axis up)": (0.0, 0.0, 1.0),
    "U6 (input axis down)": (0.0, 0.0, -1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClosedForm:
    """What the closed forms give; standard deviations only with a noise model, the rest as the positions allow."""

    azimuth: float  #: rad, of stage azimuth zero, in [0, 2 pi), by (2)
    azimuth_sd: float | None  #: rad
    latitude: float | None  #: rad, by (3), or by (12) with the ratio of the scale factors
    latitude_sd: float | None  #: rad
    latitude_reason: str  #: why there is no latitude, empty if there is one
    bias_horizontal: float  #: rad/s, by (10): the half sum
    bias_vertical: float | None  #: rad/s
    scale_factor_horizontal: float | None  #: by (10) with the known latitude
    scale_factor_vertical: float | None


def solve_closed_form(
    means: RateMeans,
    *,
    noise: NoiseModel | None = None,
    scale_factor_ratio: float = 1.0,
    known_latitude: float | None = None,
) -> ClosedForm:
    """Apply formulas (2), (3), (12) and (10) to the dwell means of one axis, in all quadrants and both hemispheres.

    Parameters
    ----------
    means : RateMeans
        Shorter means are averaged to one a dwell.
    noise : NoiseModel, optional
        For the standard deviations.
    scale_factor_ratio : float
        k of (12), the horizontal scale factor over the vertical one; 1 gives (3).
    known_latitude : float, optional
        rad, for the scale factors of (10).

    Raises
    ------
    EstimateError
        One of positions 1 to 4 is missing, or the horizontal earth rate is not distinguishable from zero.
    """
    dwells = means.per_dwell()
    first = _first_visits(dwells)
    missing = [name for name, dwell in zip(_POSITIONS, first, strict=True) if dwell is None]
    if any(name in missing for name in list(_POSITIONS)[:4]):
        raise EstimateError(f"the closed form needs positions U1 to U4, and there is no dwell at {missing[0]}")
    used = [dwell for dwell in first if dwell is not None]
    pairs = _pairs(first, dwells.n)
    half_difference = pairs @ dwells.rate[:, 0]
    half_sum = np.abs(pairs) @ dwells.rate[:, 0]
    nev = half_difference * np.array([1.0, 1.0, scale_factor_ratio])
    cov = None
    if noise is not None:
        propagate = pairs * np.array([[1.0], [1.0], [scale_factor_ratio]])
        cov = propagate @ noise.covariance(dwells) @ propagate.T
    check = checks.horizontal_rate(nev, np.zeros((3, 3)) if cov is None else cov)
    if not check.passed:
        raise EstimateError(check.sentence)
    vertical = not missing and len(used) == 6
    azimuth, latitude, _ = (float(x) for x in angles(nev))
    azimuth_sd, latitude_sd = _sds(nev, cov)
    scale_h, scale_v = _scale_factors(half_difference, known_latitude)
    return ClosedForm(
        azimuth=azimuth,
        azimuth_sd=azimuth_sd,
        latitude=latitude if vertical else None,
        latitude_sd=latitude_sd if vertical else None,
        latitude_reason="" if vertical else f"there is no dwell at {missing[0]}",
        bias_horizontal=float(half_sum[0] + half_sum[1]) / 2.0,
        bias_vertical=float(half_sum[2]) if vertical else None,
        scale_factor_horizontal=scale_h,
        scale_factor_vertical=scale_v if vertical else None,
    )


def _first_visits(dwells: RateMeans) -> list[int | None]:
    """Return the first dwell of each of the six positions, None where there is none; the measured tilt is ignored."""
    axes = sensitivity(dwells.azimuth, dwells.elevation, np.zeros((dwells.n, 2)))[:, 0]
    visits = []
    for position in _POSITIONS.values():
        near = np.flatnonzero(np.linalg.norm(axes - position, axis=1) < checks.SAME_POSITION)
        visits.append(int(near[0]) if near.size else None)
    return visits


def _pairs(first: list[int | None], n: int) -> Array:
    """Return what to multiply the dwell means by to get N, E and V: half differences of U1 U3, U4 U2, U5 U6."""
    pairs = np.zeros((3, n))
    for row, (plus, minus) in enumerate([(0, 2), (3, 1), (4, 5)]):
        a, b = first[plus], first[minus]
        if a is not None and b is not None:
            pairs[row, a], pairs[row, b] = 0.5, -0.5
    return pairs


def _sds(nev: Array, cov: Array | None) -> tuple[float | None, float | None]:
    """Return the standard deviations of azimuth and latitude, first order in the noise."""
    if cov is None:
        return None, None
    north, east, vertical = nev
    horizontal, total = math.hypot(north, east), float(nev @ nev)
    by_azimuth = np.array([-east, north, 0.0]) / horizontal**2
    by_latitude = np.array([-vertical * north / horizontal, -vertical * east / horizontal, horizontal]) / total
    return math.sqrt(by_azimuth @ cov @ by_azimuth), math.sqrt(by_latitude @ cov @ by_latitude)


def _scale_factors(half_difference: Array, latitude: float | None) -> tuple[float | None, float | None]:
    """Return the scale factors of the two planes by (10); none at a pole or on the equator, where nothing is felt."""
    if latitude is None:
        return None, None
    north, east, vertical = half_difference
    horizontal_rate, vertical_rate = EARTH_RATE * math.cos(latitude), EARTH_RATE * math.sin(latitude)
    felt = EARTH_RATE * 1e-6
    return (
        math.hypot(north, east) / horizontal_rate if abs(horizontal_rate) > felt else None,
        float(vertical / vertical_rate) if abs(vertical_rate) > felt else None,
    )
