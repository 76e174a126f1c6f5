"""From single samples, each with its number, to blocks of consecutive ones."""

from __future__ import annotations

from functools import reduce

import numpy as np
from numpy.typing import NDArray

from drivers.api import GyroStatus, RateBlock
from drivers.protocol.native import ANGLE_LSB, RATE_LSB, TEMPERATURE_LSB, US_PER_S

NUMBER_SPAN = 1 << 24
_KNOWN_STATUS = sum(GyroStatus)
Integers = NDArray[np.int64]


class SampleOrderError(ValueError):
    """Sample numbers came that one gyro cannot have sent."""


class _Axis:
    """The samples of one axis that are not yet in a block; a row is index, rate, status."""

    def __init__(self) -> None:
        self.samples: Integers = np.empty((0, 3), dtype=np.int64)
        self._newest: Integers = np.array([[-1, 0, 0]])

    @property
    def last(self) -> int:
        """Index of the newest sample, -1 if none has come."""
        return int(self._newest[0, 0])

    def add(self, numbers: Integers, rates: Integers, status: Integers) -> None:
        """Take samples in the order they came. Raises SampleOrderError for an order in which no gyro sends them."""
        steps = np.diff(numbers, prepend=self.last % NUMBER_SPAN)
        steps = (steps + NUMBER_SPAN // 2) % NUMBER_SPAN - NUMBER_SPAN // 2
        rows = np.column_stack((self.last + np.cumsum(steps), rates, status))
        before = np.concatenate((self._newest, rows[:-1]))
        for at in np.flatnonzero(steps < 0):
            raise SampleOrderError(f"its sample number went back from {before[at, 0] % NUMBER_SPAN} to {numbers[at]}")
        again = steps == 0  # a bus may deliver a frame twice
        for at in np.flatnonzero(again & (rows != before).any(axis=1)):
            raise SampleOrderError(f"sample {numbers[at]} came twice with different values")
        self.samples = np.concatenate((self.samples, rows[~again]))
        self._newest = rows[-1:]


class SampleAssembler:
    """Puts samples together into blocks.

    A block holds the samples whose indices, divided by `block_samples`, give one number; fewer where samples are
    missing. It is given out once its last sample has come, or one beyond it.

    Parameters
    ----------
    n_axes
        1 or 3.
    sample_rate
        Samples a second.
    block_samples
        Samples of a whole block.
    """

    def __init__(self, n_axes: int, sample_rate: float, block_samples: int) -> None:
        self._axes = [_Axis() for _ in range(n_axes)]
        self._sample_rate = sample_rate
        self._block_samples = block_samples
        self._fresh = False  # whether samples have come since `blocks`
        self._next = 0  # index after the newest sample given out
        self._mark = (0, 0)  # index of a sample, and its instant in us
        self._temperature: float | None = None
        self._tilt: tuple[float, float] | None = None

    @property
    def n_seen(self) -> int:
        """Index of the newest sample that has come, plus 1."""
        return self._axes[0].last + 1

    def mark(self, number: int, time_us: int) -> None:
        """Note the instant of a sample."""
        newest = self._axes[0].last
        step = (number - newest + NUMBER_SPAN // 2) % NUMBER_SPAN - NUMBER_SPAN // 2
        self._mark = newest + step, time_us

    def note(self, temperature: int, tilt_x: int, tilt_y: int) -> None:
        """Note temperature and tilt, in the units of the wire."""
        self._temperature = temperature * TEMPERATURE_LSB
        self._tilt = (tilt_x * ANGLE_LSB, tilt_y * ANGLE_LSB)

    def add(self, axis: int, numbers: Integers, rates: Integers, status: Integers) -> None:
        """Take samples of an axis in the order they came, shape (n,) each.

        Raises
        ------
        SampleOrderError
            If their numbers went back, or one came twice with different values.
        """
        if len(numbers):
            self._fresh = True
            self._axes[axis].add(numbers, rates, status)

    def blocks(self, now: float, *, flush: bool = False) -> list[RateBlock]:
        """Return the blocks that are complete; with `flush` also the one under way."""
        if not (self._fresh or flush):
            return []
        self._fresh = False
        samples = self._common()
        end = samples[-1, 0] + 1 if len(samples) else 0
        if not flush:
            end -= end % self._block_samples
        n_whole = int(np.searchsorted(samples[:, 0], end))
        whole = samples[:n_whole]
        for axis in self._axes:
            if n_whole:
                axis.samples = axis.samples[np.searchsorted(axis.samples[:, 0], end) :]
        index = whole[:, 0]
        edges = np.flatnonzero((np.diff(index) != 1) | (np.diff(index // self._block_samples) != 0)) + 1
        return [self._block(run, now) for run in np.split(whole, edges) if len(run)]

    def _common(self) -> Integers:
        """Return the samples that all axes have, shape (n, 1 + 2 n_axes): index, then rate and status of each axis."""
        held = [axis.samples for axis in self._axes]
        if len(held) == 1:
            return held[0]
        index = reduce(lambda a, b: np.intersect1d(a, b, assume_unique=True), [samples[:, 0] for samples in held])
        chosen = [samples[np.searchsorted(samples[:, 0], index)][:, 1:] for samples in held]
        return np.column_stack((index, *chosen))

    def _block(self, run: Integers, now: float) -> RateBlock:
        """Return consecutive samples as a block."""
        first = int(run[0, 0])
        n_lost, self._next = first - self._next, first + len(run)
        status = int(np.bitwise_or.reduce(run[:, 2::2], axis=None)) & _KNOWN_STATUS
        marked, time_us = self._mark
        return RateBlock(
            first_index=first,
            device_time=time_us / US_PER_S + (first - marked) / self._sample_rate,
            arrival_time=now,
            counts=np.ascontiguousarray(run[:, 1::2], dtype=np.int32),
            rate_lsb=RATE_LSB,
            temperature=self._temperature,
            tilt=self._tilt,
            status=GyroStatus(status),
            n_lost=n_lost,
        )
