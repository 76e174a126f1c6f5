"""Many blocks of samples as columns: what reductions compute with, from a gyro and from a record alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.api import RateBlock, RateCounts

Array = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BlockColumns:
    """m consecutive blocks with n samples in all; what was not measured is nan."""

    first_index: Whole  #: of each block's first sample, shape (m,)
    n_samples: Whole  #: (m,)
    device_time: Array  #: s, at the first sample, (m,)
    rate_lsb: Array  #: rad/s per count, (m,)
    temperature: Array  #: degrees Celsius, (m,)
    tilt: Array  #: rad, (m, 2)
    specific_force: Array  #: m/s^2, (m, 3)
    status: Whole  #: bits of `drivers.api.GyroStatus`, (m,)
    counts: RateCounts  #: (n, n_axes)

    @property
    def rate(self) -> Array:
        """Rate in rad/s, shape (n, n_axes)."""
        if self.rate_lsb.size and np.all(self.rate_lsb == self.rate_lsb[0]):
            return self.counts.astype(np.float64) * float(self.rate_lsb[0])
        return np.asarray(self.counts.astype(np.float64) * np.repeat(self.rate_lsb, self.n_samples)[:, np.newaxis])

    @property
    def stop_index(self) -> Whole:
        """One past the last sample of each block, shape (m,)."""
        return self.first_index + self.n_samples

    def part(self, first: int, stop: int) -> BlockColumns:
        """Return the blocks from number `first` to before `stop`."""
        offset = np.concatenate([[0], np.cumsum(self.n_samples)])
        names = (
            "first_index",
            "n_samples",
            "device_time",
            "rate_lsb",
            "temperature",
            "tilt",
            "specific_force",
            "status",
        )
        of_blocks: dict[str, Any] = {name: getattr(self, name)[first:stop] for name in names}
        return BlockColumns(counts=self.counts[offset[first] : offset[stop]], **of_blocks)


def columns_of_blocks(blocks: Sequence[RateBlock]) -> BlockColumns:
    """Return `blocks`, at least one, as columns."""
    nothing = (np.nan, np.nan, np.nan)
    return BlockColumns(
        first_index=np.array([block.first_index for block in blocks]),
        n_samples=np.array([len(block.counts) for block in blocks]),
        device_time=np.array([block.device_time for block in blocks]),
        rate_lsb=np.array([block.rate_lsb for block in blocks]),
        temperature=np.array([np.nan if block.temperature is None else block.temperature for block in blocks]),
        tilt=np.array([nothing[:2] if block.tilt is None else block.tilt for block in blocks]),
        specific_force=np.array([block.specific_force or nothing for block in blocks]),
        status=np.array([int(block.status) for block in blocks]),
        counts=np.concatenate([block.counts for block in blocks]),
    )
