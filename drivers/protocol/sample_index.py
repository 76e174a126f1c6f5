"""Which sample is which, from a counter in each frame that soon begins again.

A counter of 8 bits that counts at 2,000 Hz is back after 128 ms, so a longer gap is known only but for a multiple of
that. Then the time of arrival decides, if the host's clock and the samples run at the same pace: not with an emulator
faster than real time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

_HISTORY = 1.0  # s, before the pace is known
_PACE_TOLERANCE = 0.05  # of samples against the host's clock
_SLACK = 0.15  # of a turn, for jitter and drift
_PATIENCE = 1.0  # s for which samples have to come late before some are held to be missing
_DRIFT = 2e-4  # by which the host's and the gyro's clocks may differ


class CounterError(ValueError):
    """A counter went where no loss of samples can bring it."""


@dataclass(frozen=True, slots=True)
class Numbered:
    """Samples with their index."""

    index: NDArray[np.int64]  #: rising, shape (n,)
    unsure: int | None = None  #: which of them follows a gap whose length does not rest on the counter alone

    def only(self, kept: NDArray[np.bool_]) -> Numbered:
        """Return those of the samples that are kept, shape (n,)."""
        unsure = None if self.unsure is None else int(np.count_nonzero(kept[: self.unsure]))
        return Numbered(self.index[kept], unsure)


class SampleIndex:
    """Numbers the samples of a stream from 0 on.

    Parameters
    ----------
    span
        How many values the counter has.
    step
        By how much it rises from sample to sample; a divisor of `span`.
    sample_rate
        Samples a second.
    """

    def __init__(self, *, span: int, step: int, sample_rate: float) -> None:
        self._span = span
        self._step = step
        self._rate = sample_rate
        self._wrap = span // step  # samples after which the counter is back
        self._counter: int | None = None
        self._next = 0
        self._n_first = 0  # samples that the first call brought
        self._began = self._heard = 0.0
        self._late_since: float | None = None
        self._least_turns = 0
        self._paced = False
        self._offset = 0.0  # host's time of sample 0, had it come without delay

    @property
    def next_index(self) -> int:
        """Index of the sample after the last one numbered."""
        return self._next

    def number(self, counters: NDArray[np.integer], now: float, *, damaged: bool = False) -> Numbered:
        """Return the index of each sample that has arrived, oldest first.

        Parameters
        ----------
        counters
            Of each sample, shape (n,), n > 0.
        now
            The host's time at which the last of them came, s.
        damaged
            Whether the line has lost something since the last call.

        Raises
        ------
        CounterError
            If a counter has not gone on by a multiple of its step.
        """
        if self._counter is None:
            self._counter = (int(counters[0]) - self._step) % self._span
            self._began = self._heard = now
            self._n_first = len(counters)
            self._offset = now - len(counters) / self._rate
        rises = (counters - np.concatenate(([self._counter], counters[:-1]))).astype(np.int64) % self._span
        self._check(counters, rises)
        missing = (rises // self._step - 1) % self._wrap
        index = self._next + np.cumsum(missing + 1) - 1
        gaps = np.flatnonzero(missing)
        place = int(gaps[-1]) if len(gaps) else 0
        turns = self._turns(int(index[-1]), now, lossy=damaged or len(gaps) > 0)
        index[place:] += turns * self._wrap
        sure = not turns and (not len(gaps) or self._keeps_pace())
        self._offset = min(self._offset + _DRIFT * (now - self._heard), now - (index[-1] + 1) / self._rate)
        self._counter, self._next, self._heard = int(counters[-1]), int(index[-1]) + 1, now
        return Numbered(index, None if sure else place)

    def _check(self, counters: NDArray[np.integer], rises: NDArray[np.int64]) -> None:
        wrong = np.flatnonzero(rises % self._step)
        if len(wrong):
            i = int(wrong[0])
            came_from = self._counter if i == 0 else int(counters[i - 1])
            raise CounterError(f"went from {came_from} to {int(counters[i])}, where it rises by {self._step} a sample")

    def _turns(self, newest: int, now: float, *, lossy: bool) -> int:
        """Return how many whole turns of the counter are missing besides what it tells.

        Where nothing else speaks of a loss, samples that come late may wait in a buffer: then they have to be late for
        a while.
        """
        if not self._keeps_pace():
            return 0
        late = (now - self._offset) * self._rate - (newest + 1)
        turns = int(late / self._wrap + _SLACK)  # never early: what counts as late is held against the least delay seen
        if turns <= 0:
            self._late_since = None
            return 0
        if self._late_since is None:
            self._late_since, self._least_turns = now, turns
        self._least_turns = min(self._least_turns, turns)
        if not lossy and now - self._late_since < _PATIENCE:
            return 0
        self._late_since = None
        return turns if lossy else self._least_turns

    def _keeps_pace(self) -> bool:
        """Return whether samples have come at their rate by the host's clock up to when they began to come late."""
        passed = self._heard - self._began
        if self._late_since is None and passed >= _HISTORY:
            self._paced = abs((self._next - self._n_first) / self._rate / passed - 1) < _PACE_TOLERANCE
        return self._paced


@dataclass(frozen=True, slots=True)
class Part:
    """Consecutive samples of equal status."""

    where: slice  #: among those that were numbered
    first: int  #: index of the first
    n_lost: int  #: missing between the part before and this one
    unsure: bool  #: whether `n_lost` does not rest on the counter alone


def parts(numbered: Numbered, status: NDArray[np.integer], *, expected: int, longest: int) -> list[Part]:
    """Cut samples at gaps and where their status changes, so that no part is longer than `longest`.

    Parameters
    ----------
    numbered
        The samples.
    status
        Of each, shape (n,).
    expected
        Index of the sample that should have come first.
    longest
        Samples.
    """
    index = numbered.index
    breaks = np.flatnonzero((np.diff(index) != 1) | (np.diff(status.astype(np.int64)) != 0)) + 1
    found = []
    for start, stop in pairwise([0, *breaks.tolist(), len(index)]):
        for begin in range(start, stop, longest):
            first = int(index[begin])
            found.append(
                Part(slice(begin, min(begin + longest, stop)), first, first - expected, begin == numbered.unsure)
            )
            expected = int(index[found[-1].where.stop - 1]) + 1
    return found
