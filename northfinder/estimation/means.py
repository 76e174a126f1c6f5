"""Interval means of the rate with the measured attitude of the input axis: what every estimator takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from northfinder.errors import EstimateError

Array = NDArray[np.float64]

#: Two instants closer than this part of a sample are one: neighbours then share the end point and its angle noise.
SAME_INSTANT = 0.1


@dataclass(frozen=True, slots=True, eq=False, init=False)
class RateMeans:
    """Mean rates over intervals, in order of time, n of them; between them may be gaps of any length.

    Attributes
    ----------
    start, duration : (n,) arrays
        Interval, s. An interval of k samples lasts k sample periods, so neighbours without a gap share an end point.
    rate : (n, n_axes) array
        Mean rate about each input axis, rad/s; (n,) is taken for one axis.
    azimuth, elevation : (n,) arrays
        Measured stage angles, rad.
    tilt : (n, 2) array
        Measured tilt of the pedestal, rad; zero if not given.
    specific_force : (n, 3) array
        Along the axes of a triad, m/s^2, an upward axis reading +g; zero if not given.
    dwell : (n,) int array
        Which dwell a mean belongs to, never decreasing; numbered 0, 1, ... if not given.
    n_samples : (n,) int array
        Samples in the mean; 1 if not given.
    turn_on : (n,) int array
        How many times the gyro had been switched off and on by then, never decreasing; 0 if not given.

    Raises
    ------
    ValueError
        The arrays do not fit each other.
    EstimateError
        There are no data, a value is not finite, or the intervals overlap or are out of order.
    """

    start: Array
    duration: Array
    rate: Array
    azimuth: Array
    elevation: Array
    tilt: Array
    specific_force: Array
    dwell: NDArray[np.int64]
    n_samples: NDArray[np.int64]
    turn_on: NDArray[np.int64]

    def __init__(
        self,
        *,
        start: ArrayLike,
        duration: ArrayLike,
        rate: ArrayLike,
        azimuth: ArrayLike,
        elevation: ArrayLike,
        tilt: ArrayLike | None = None,
        specific_force: ArrayLike | None = None,
        dwell: ArrayLike | None = None,
        n_samples: ArrayLike | None = None,
        turn_on: ArrayLike | None = None,
    ) -> None:
        given = {"start": start, "duration": duration, "rate": rate, "azimuth": azimuth, "elevation": elevation}
        for name, value in given.items():
            object.__setattr__(self, name, np.array(value, dtype=np.float64))
        if self.rate.ndim == 1:
            object.__setattr__(self, "rate", self.rate[:, np.newaxis])
        n = self.start.size
        for name, beside, width in (("tilt", tilt, 2), ("specific_force", specific_force, 3)):
            given_or_zero = np.zeros((n, width)) if beside is None else np.array(beside, dtype=np.float64)
            object.__setattr__(self, name, given_or_zero)
        whole = {"dwell": np.arange(n) if dwell is None else dwell}
        whole["n_samples"] = np.ones(n, dtype=np.int64) if n_samples is None else n_samples
        whole["turn_on"] = np.zeros(n, dtype=np.int64) if turn_on is None else turn_on
        for name, value in whole.items():
            object.__setattr__(self, name, np.array(value, dtype=np.int64))
        self._check()

    def _check(self) -> None:
        n = self.start.size
        for field in fields(self):
            array = getattr(self, field.name)
            widths = {"rate": self.rate.shape[-1], "tilt": 2, "specific_force": 3}
            expected = (n, widths[field.name]) if field.name in widths else (n,)
            if array.shape != expected:
                raise ValueError(f"{field.name} has shape {array.shape}, expected {expected}")
            if not np.all(np.isfinite(array)):
                row = int(np.argwhere(~np.isfinite(array))[0][0])
                raise EstimateError(f"{field.name} of mean {row} is not a finite number")
        if n == 0:
            raise EstimateError("there are no rate means to estimate from")
        if np.any(self.duration <= 0.0) or np.any(self.n_samples < 1):
            raise EstimateError("every mean needs a positive duration and at least one sample")
        if np.any(self.gap < 0.0) or np.any(np.diff(self.dwell) < 0) or np.any(np.diff(self.turn_on) < 0):
            raise EstimateError("the means must be in order of time and must not overlap")

    @property
    def n(self) -> int:
        """How many means there are."""
        return int(self.start.size)

    @property
    def n_axes(self) -> int:
        """How many input axes a mean holds."""
        return int(self.rate.shape[1])

    @property
    def middle(self) -> Array:
        """Middle of each interval, s, shape (n,)."""
        return self.start + 0.5 * self.duration

    @property
    def gap(self) -> Array:
        """Gap before each mean but the first, s, shape (n - 1,); exactly 0 where two means share an end point."""
        gap = self.start[1:] - (self.start[:-1] + self.duration[:-1])
        period = self.duration / self.n_samples
        shared = np.abs(gap) <= SAME_INSTANT * np.minimum(period[1:], period[:-1])
        return cast("Array", np.where(shared, 0.0, gap))

    def select(self, keep: NDArray[np.bool_]) -> RateMeans:
        """Return the means for which `keep`, shape (n,), is true."""
        return RateMeans(**{field.name: getattr(self, field.name)[keep] for field in fields(self)})

    def with_rate(self, rate: ArrayLike) -> RateMeans:
        """Return means over the same intervals at the same attitudes with other rates."""
        return self._changed(rate=rate)

    def with_tilt(self, tilt: tuple[float, float]) -> RateMeans:
        """Return the same means on a pedestal with that tilt, rad."""
        return self._changed(tilt=np.tile(tilt, (self.n, 1)))

    def _changed(self, **changes: ArrayLike) -> RateMeans:
        return RateMeans(**{field.name: getattr(self, field.name) for field in fields(self)} | changes)

    def per_dwell(self) -> RateMeans:
        """Return the mean over each unbroken run within a dwell: one a dwell, more where data are missing inside it."""
        new_run = np.concatenate([[True], (self.gap != 0.0) | (np.diff(self.dwell) != 0)])
        first = np.flatnonzero(new_run)
        total = np.add.reduceat(self.duration, first)

        def mean(values: Array) -> Array:
            weight = self.duration.reshape(-1, *[1] * (values.ndim - 1))
            return np.add.reduceat(values * weight, first) / total.reshape(-1, *[1] * (values.ndim - 1))

        names = ("rate", "azimuth", "elevation", "tilt", "specific_force")
        averaged = {name: mean(getattr(self, name)) for name in names}
        whole = {"dwell": self.dwell[first], "turn_on": self.turn_on[first]}
        n_samples = np.add.reduceat(self.n_samples, first)
        return RateMeans(start=self.start[first], duration=total, n_samples=n_samples, **whole, **averaged)


def concatenate(parts: Sequence[RateMeans]) -> RateMeans:
    """Return the means of all `parts`, which follow one another in time."""
    if not parts:
        raise EstimateError("there are no rate means to estimate from")
    return RateMeans(
        **{field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(RateMeans)}
    )


def from_samples(
    rate: ArrayLike,
    first_index: int,
    sample_rate: float,
    *,
    samples_per_mean: int,
    azimuth: float,
    elevation: float,
    tilt: tuple[float, float] = (0.0, 0.0),
    specific_force: ArrayLike = (0.0, 0.0, 0.0),
    dwell: int = 0,
    stream_start: float = 0.0,
    turn_on: int = 0,
) -> RateMeans:
    """Average one unbroken run of samples at one attitude into means of `samples_per_mean`, the last one shorter.

    Parameters
    ----------
    rate : (n,) or (n, n_axes) array
        Samples, rad/s.
    first_index : int
        Index of the first sample; the start of a sample is its index over `sample_rate` (1/s).
    samples_per_mean : int
        Samples in a mean; a remainder at the end becomes a shorter mean.
    azimuth, elevation, tilt, specific_force, dwell
        Of the whole run, as in `RateMeans`; the specific force of each mean where it has that shape.

    Returns
    -------
    RateMeans
    """
    samples = np.asarray(rate, dtype=np.float64)
    if samples.size == 0:
        raise EstimateError(f"there are no samples to average in dwell {dwell}")
    samples = samples.reshape(len(samples), -1)
    first = np.arange(0, samples.shape[0], samples_per_mean)
    n_samples = np.diff(np.append(first, samples.shape[0]))
    n = first.size
    return RateMeans(
        start=stream_start + (first_index + first) / sample_rate,
        duration=n_samples / sample_rate,
        rate=np.add.reduceat(samples, first) / n_samples[:, np.newaxis],
        azimuth=np.full(n, azimuth),
        elevation=np.full(n, elevation),
        tilt=np.tile(tilt, (n, 1)),
        specific_force=np.broadcast_to(specific_force, (n, 3)),
        dwell=np.full(n, dwell),
        turn_on=np.full(n, turn_on),
        n_samples=n_samples,
    )
