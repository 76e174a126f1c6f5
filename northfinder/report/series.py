"""Long series made short enough to draw, without losing a single peak: least, greatest and mean of each stretch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """What is left of a long series, one row a stretch that holds any value; x in the unit of the index."""

    x: Array  #: (n,) middle of each stretch
    low: Array  #: (n, n_columns)
    mean: Array  #: (n, n_columns)
    high: Array  #: (n, n_columns)


class Envelope:
    """Takes values by their index, in any amount, and keeps at most `n_bins` stretches of equal length.

    When the values outgrow the stretches these are joined in pairs, so that memory stays the same however long the
    series becomes.
    """

    def __init__(self, n_columns: int, *, n_bins: int = 1024, first: int = 0, width: int = 1) -> None:
        """Begin at index `first`, with stretches of `width` indices."""
        if n_bins < 2 or n_bins % 2:
            raise ValueError(f"an even number of stretches is needed, not {n_bins}")
        self._first = first
        self._width = width
        self._low = np.full((n_bins, n_columns), np.inf)
        self._high = np.full((n_bins, n_columns), -np.inf)
        self._total = np.zeros((n_bins, n_columns))
        self._count = np.zeros(n_bins, dtype=np.int64)

    def add(self, index: int, values: Array) -> None:
        """Take the values (n, n_columns) of indices `index`, `index` + 1, ...; those before the first are left out."""
        skipped = max(0, self._first - index)
        values, index = values[skipped:], index + skipped
        if not len(values):
            return
        while (index + len(values) - 1 - self._first) // self._width >= len(self._count):
            self._join_pairs()
        bins = (np.arange(index, index + len(values)) - self._first) // self._width
        starts = np.concatenate([[0], np.flatnonzero(np.diff(bins)) + 1])
        touched = bins[starts]
        self._low[touched] = np.minimum(self._low[touched], np.minimum.reduceat(values, starts))
        self._high[touched] = np.maximum(self._high[touched], np.maximum.reduceat(values, starts))
        self._total[touched] += np.add.reduceat(values, starts)
        self._count[touched] += np.diff(np.append(starts, len(values)))

    def _join_pairs(self) -> None:
        half = len(self._count) // 2
        for kept, joined, empty in (
            (self._low, np.minimum(self._low[::2], self._low[1::2]), np.inf),
            (self._high, np.maximum(self._high[::2], self._high[1::2]), -np.inf),
            (self._total, self._total[::2] + self._total[1::2], 0.0),
        ):
            kept[:half], kept[half:] = joined, empty
        self._count[:half], self._count[half:] = self._count[::2] + self._count[1::2], 0
        self._width *= 2

    def series(self) -> Series:
        """Return what has been taken so far."""
        held = np.flatnonzero(self._count)
        return Series(
            x=np.asarray(self._first + (held + 0.5) * self._width, dtype=np.float64),
            low=self._low[held],
            mean=self._total[held] / self._count[held, None],
            high=self._high[held],
        )


def thinned(x: Array, y: Array, *, n_columns: int = 700) -> tuple[Array, Array]:
    """Return the points of a line (n,) that a picture of `n_columns` columns shows: two of each, its ends and peaks."""
    if len(x) <= 2 * n_columns:
        return x, y
    starts = np.unique(np.linspace(0, len(x), n_columns, endpoint=False).astype(np.int64))
    stops = np.append(starts[1:], len(x))
    kept = sorted(
        {
            int(start + at)
            for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)
            for at in (np.argmin(y[start:stop]), np.argmax(y[start:stop]))
        }
        | {0, len(x) - 1}
    )
    return x[kept], y[kept]
