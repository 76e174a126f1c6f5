"""Statistics of repeated measurements: means, scatter, and whether the scatter is what was stated."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def circular_mean(angles: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Return the mean direction of `angles`, rad, in (-pi, pi]; of angles near one another, their weighted mean.

    The mean about the mean direction, so that for angles that do not span the circle it is their arithmetic mean.
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
