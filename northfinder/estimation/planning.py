"""How sure a fix will be, before anything is measured: the covariance of `estimate` on dwells that are only planned.

The covariance of least squares does not depend on the rates, so noise-free rates at an assumed azimuth and latitude
give the very standard deviations that `estimate` will state after the measurement, where the noise model fits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from northfinder.errors import EstimateError
from northfinder.estimation.fix import Known
from northfinder.estimation.geometry import rates, sensitivity
from northfinder.estimation.least_squares import estimate
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel

#: Samples a second assumed; what matters is only that a mean holds many.
_SAMPLE_RATE = 200.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedDwell:
    """One dwell of a plan, in time and attitude."""

    start: float  #: s
    duration: float  #: s
    azimuth: float  #: rad, of the stage
    elevation: float  #: rad


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What the planner takes for the truth, rad; the scale factor is the known one, else 1."""

    azimuth: float = math.radians(33.0)  #: of stage azimuth zero; no multiple of 90 deg, so that no plan is favoured
    latitude: float = math.radians(45.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Standard deviations that `estimate` will state, rad."""

    azimuth_sd: float
    latitude_sd: float | None  #: None where the dwells do not measure the latitude


def planned_means(
    dwells: Sequence[PlannedDwell], truth: Truth, *, known: Known, interval: float = 1.0, n_axes: int = 1
) -> RateMeans:
    """Return noise-free means over `interval` s, the last one of a dwell shorter, as measured ones would be cut."""
    counts = [max(1, math.ceil(dwell.duration / interval - 1e-6)) for dwell in dwells]
    order = np.repeat(np.arange(len(dwells)), counts)
    offset = np.concatenate([np.arange(n) * interval for n in counts])
    start, length, azimuth, elevation = (
        np.array([getattr(dwell, name) for dwell in dwells])[order]
        for name in ("start", "duration", "azimuth", "elevation")
    )
    duration = np.minimum(interval, length - offset)
    h = sensitivity(azimuth, elevation, np.zeros((order.size, 2)), n_axes=n_axes)
    nev = rates(truth.azimuth, truth.latitude, known.scale_factor or 1.0)
    nev[2] += known.acceleration_sensitive_drift_rate
    return RateMeans(
        start=start + offset,
        duration=duration,
        rate=h @ nev,
        azimuth=azimuth,
        elevation=elevation,
        dwell=order,
        n_samples=np.maximum(1, np.round(duration * _SAMPLE_RATE)),
    )


def predict(
    dwells: Sequence[PlannedDwell],
    noise: NoiseModel,
    known: Known,
    truth: Truth,
    *,
    interval: float = 1.0,
    n_axes: int = 1,
) -> Prediction:
    """Return the standard deviations that generalised least squares will state after these dwells.

    Parameters
    ----------
    dwells : sequence of PlannedDwell
        In order of time.
    noise, known
        As they will be given to `estimate`.
    truth : Truth
        At which the covariance is taken.
    interval : float
        Length of the means, s.
    n_axes : int
        Of the gyro, 1 or 3.

    Raises
    ------
    EstimateError
        The dwells do not determine an azimuth, or not out of the noise.
    """
    if not dwells:
        raise EstimateError("a plan without a dwell determines nothing")
    means = planned_means(dwells, truth, known=known, interval=interval, n_axes=n_axes)
    fix = estimate(means, noise=noise, known=known, weights="generalised")
    return Prediction(azimuth_sd=fix.azimuth_sd, latitude_sd=None if known.latitude is not None else fix.latitude_sd)
