"""From the rates N, E, V to azimuth, latitude and scale factor, with what is known of them ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from northfinder.errors import EstimateError
from northfinder.estimation import checks
from northfinder.estimation.fix import Known
from northfinder.estimation.geometry import angles, rates, rates_jacobian
from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]

_CONVERGED = 1e-12  # rad, and of the scale factor


def require_horizontal(nev: Array, covariance: Array) -> checks.Check:
    """Return the check of the horizontal earth rate. Raises EstimateError if it fails: there is no azimuth then."""
    check = checks.horizontal_rate(nev, covariance)
    if not check.passed:
        raise EstimateError(f"{check.sentence}; the data are too few or too noisy, or a pole is too near")
    return check


@dataclass(frozen=True, slots=True, eq=False)
class Angles:
    """Azimuth, latitude and scale factor with their covariance; None for what the data do not determine."""

    value: Array  # (3,) azimuth, latitude, scale factor
    covariance: Array  # (3, 3)
    latitude: float | None
    scale_factor: float | None

    def sd(self, index: int) -> float:
        """Return the standard deviation of one of them."""
        return math.sqrt(max(float(self.covariance[index, index]), 0.0))


def constrain(nev: Array, covariance: Array, known: Known) -> Angles:
    """Return the angles of the measured N, E, V, by Gauss-Newton with what is known of latitude and scale factor."""
    value = angles(nev)
    prior = [(1, known.latitude, known.latitude_sd), (2, known.scale_factor, known.scale_factor_sd)]
    given = [(index, target, sd) for index, target, sd in prior if target is not None]
    free = np.array([(index, 0.0) not in [(i, sd) for i, _, sd in given] for index in range(3)])
    for index, target, _ in given:
        value[index] = target
    whiten = np.linalg.inv(np.linalg.cholesky(covariance + (1e-12 * EARTH_RATE) ** 2 * np.eye(3)))
    soft = [(np.eye(3)[index] / sd, target, sd) for index, target, sd in given if sd > 0.0]
    for _ in range(10):
        rows = np.vstack([whiten @ rates_jacobian(*value), *[row for row, _, _ in soft]])[:, free]
        misfit = [*(whiten @ (nev - rates(*value))), *[(target - row @ value * sd) / sd for row, target, sd in soft]]
        step = np.linalg.lstsq(rows, np.array(misfit), rcond=None)[0]
        value[free] += step
        if np.max(np.abs(step), initial=0.0) < _CONVERGED:
            break
    require_horizontal(rates(*value), covariance)
    cov = np.zeros((3, 3))
    cov[np.ix_(free, free)] = np.linalg.inv(rows.T @ rows)
    return Angles(value, cov, float(value[1]), float(value[2]))


def horizontal_only(nev: Array, covariance: Array, known: Known) -> Angles:
    """Return the azimuth of N and E alone; latitude as known, and then the scale factor from the horizontal rate."""
    north, east = float(nev[0]), float(nev[1])
    horizontal = math.hypot(north, east)
    direction = np.array([[-east / horizontal**2, north / horizontal**2], [north / horizontal, east / horizontal]])
    cov = direction @ covariance[:2, :2] @ direction.T  # of azimuth and of the horizontal rate
    full = np.zeros((3, 3))
    full[0, 0] = cov[0, 0]
    scale_factor = known.scale_factor
    full[2, 2] = known.scale_factor_sd**2
    if known.latitude is not None:
        full[1, 1] = known.latitude_sd**2
        if scale_factor is None:
            scale_factor = horizontal / (EARTH_RATE * math.cos(known.latitude))
            relative = math.hypot(math.sqrt(cov[1, 1]) / horizontal, math.tan(known.latitude) * known.latitude_sd)
            full[2, 2] = (scale_factor * relative) ** 2
    azimuth = math.atan2(east, north)
    value = np.array([azimuth, known.latitude or 0.0, scale_factor or 1.0])
    return Angles(value, full, known.latitude, scale_factor)


def agreements(nev: Array, covariance: Array, known: Known, sd_dof: float) -> list[checks.Check]:
    """Return whether the latitude and the scale factor that the data alone give agree with the known ones."""
    alone = constrain(nev, covariance, Known())
    found = []
    if known.latitude is not None:
        sd = math.hypot(alone.sd(1), known.latitude_sd)
        found.append(checks.agreement("latitude", alone.value[1] - known.latitude, sd, "rad", sd_dof))
    if known.scale_factor is not None:
        sd = math.hypot(alone.sd(2), known.scale_factor_sd)
        found.append(checks.agreement("scale factor", alone.value[2] - known.scale_factor, sd, "1", sd_dof))
    return found
