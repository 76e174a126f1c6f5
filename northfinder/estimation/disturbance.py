"""Disturbed means: steps, wind and knocks found by their distance from the rest of their dwell, whatever the noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from northfinder.estimation.means import RateMeans

Array = NDArray[np.float64]

#: Means this many robust standard deviations from the median of their dwell are disturbed: two in a million good ones.
LIMIT = 5.0
#: A dwell with fewer means cannot tell which of them is wrong.
ENOUGH = 5
_SD_OF_MEDIAN_DEVIATION = 1.4826  # of Gaussian noise (Rousseeuw and Croux, J. Am. Stat. Assoc. 88, 1993, p. 1273)


def undisturbed(means: RateMeans, *, limit: float = LIMIT) -> NDArray[np.bool_]:
    """Return which means to keep, shape (n,): those near the median of their dwell on every axis.

    The scale is the median absolute deviation over all dwells; up to half of the means may be disturbed without
    spoiling it. A mean longer or shorter than most is judged as if its noise went as the least favourable power of its
    duration: the square root for a longer one (angle random walk), the duration itself for a shorter one (angle white
    noise), so that the odd short mean at the end of a dwell is not taken for a knock. Use with `RateMeans.select`.
    """
    _, dwell = np.unique(means.dwell, return_inverse=True)
    judged = np.bincount(dwell)[dwell] >= ENOUGH
    if not judged.any():
        return np.ones(means.n, dtype=bool)
    of_dwells = np.split(means.rate, np.flatnonzero(np.diff(dwell)) + 1)
    median = np.array([np.median(rate, axis=0) for rate in of_dwells])
    ratio = means.duration / np.median(means.duration)
    length = np.minimum(ratio, np.sqrt(ratio))[:, np.newaxis]
    distance = np.abs(means.rate - median[dwell]) * length
    scale = _SD_OF_MEDIAN_DEVIATION * np.median(distance[judged], axis=0)
    rounding = np.finfo(np.float64).eps * np.max(np.abs(means.rate))
    return np.asarray(~judged | np.all(distance <= limit * scale + rounding, axis=1))
