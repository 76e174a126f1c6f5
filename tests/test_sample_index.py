"""Numbering of samples by a short counter: every gap by the counter, longer ones by the time of arrival."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.protocol.sample_index import CounterError, Numbered, Part, SampleIndex, parts

RATES = (125, 250, 500, 1000, 2000)


def stim(rate: int) -> SampleIndex:
    """Return the numbering of an STIM300."""
    return SampleIndex(span=256, step=2000 // rate, sample_rate=rate)


def counters(index: NDArray[np.integer], rate: int, first: int = 0) -> NDArray[np.integer]:
    """Return the counters of an STIM300's samples."""
    return ((first + index * (2000 // rate)) % 256).astype(np.uint8)


@given(st.sampled_from(RATES), st.integers(0, 255), st.integers(0, 2**32), st.floats(0, 0.3))
def test_losses_shorter_than_a_turn(rate: int, first: int, seed: int, loss: float) -> None:
    """Whatever is lost, up to a turn of the counter less one sample, each sample gets its own index."""
    rng = np.random.default_rng(seed)
    turn = 256 // (2000 // rate)
    kept = np.flatnonzero(rng.random(600) >= loss)
    kept = kept[np.concatenate(([True], np.diff(kept) < turn))] if len(kept) else kept
    if not len(kept) or (np.diff(kept) >= turn).any():
        return
    numbering = stim(rate)
    found = []
    for part in np.array_split(kept, rng.integers(1, 20)):
        if len(part):
            now = part[-1] / rate + rng.uniform(0, 0.02)
            found += numbering.number(counters(part, rate, first), now, damaged=bool(rng.integers(2))).index.tolist()
    assert found == (kept - kept[0]).tolist()
    assert numbering.next_index == found[-1] + 1


@given(
    st.sampled_from(RATES), st.integers(1, 4000), st.floats(0.01, 0.2), st.integers(0, 2**32), st.floats(-1e-4, 1e-4)
)
def test_long_gaps_by_the_time_of_arrival(rate: int, gap_ms: int, batch: float, seed: int, drift: float) -> None:
    """A gap of any length is found in real time and flagged, though samples come in batches and up to 30 ms late."""
    rng = np.random.default_rng(seed)
    missing = max(1, gap_ms * rate // 1000)
    begin = 5 * rate
    index = np.concatenate([np.arange(begin), np.arange(begin + missing, begin + missing + 5 * rate)])
    numbering = stim(rate)
    size = max(1, round(batch * rate))
    unsure = []
    for part in [*np.array_split(index[:begin], begin // size), *np.array_split(index[begin:], 5 * rate // size)]:
        now = (part[-1] + 1) / rate * (1 + drift) + rng.uniform(0, 0.03)
        numbered = numbering.number(counters(part, rate), now, damaged=part[0] == begin + missing)
        assert numbered.index.tolist() == part.tolist()
        unsure += [] if numbered.unsure is None else [int(numbered.index[numbered.unsure])]
    assert unsure == ([begin + missing] if missing >= 256 // (2000 // rate) else [])


def test_a_gap_of_whole_turns_that_nothing_tells_of() -> None:
    """When exactly a turn is missing and the line shows no damage, it is found once samples have come late for 1 s."""
    numbering = stim(125)
    for begin in range(0, 1250, 25):
        numbering.number(counters(np.arange(begin, begin + 25), 125), (begin + 25) / 125)
    at = []
    for begin in range(1250 + 32, 2500, 25):
        numbered = numbering.number(counters(np.arange(begin, begin + 25), 125), (begin + 25) / 125)
        if numbered.unsure is not None:
            at.append(begin)
            assert numbered.index[0] == begin
    assert len(at) == 1
    assert numbering.next_index == begin + 25


def test_a_busy_host_loses_nothing() -> None:
    """Samples that have waited in a buffer, up to a second, are numbered without a gap."""
    numbering = stim(2000)
    now = 0.0
    for begin in range(0, 20_000, 400):
        now = (begin + 400) / 2000 + (0.9 if begin in range(8000, 9600) else 0.0)
        numbered = numbering.number(counters(np.arange(begin, begin + 400), 2000), now)
        assert (numbered.index[0], numbered.unsure) == (begin, None)


def test_faster_than_real_time_the_counter_decides() -> None:
    """Where samples do not keep the host's pace, a gap is flagged, and is as long as the counter says."""
    numbering = stim(125)
    for begin in range(0, 5000, 25):
        numbering.number(counters(np.arange(begin, begin + 25), 125), begin / 12_500)
    numbered = numbering.number(counters(np.arange(5000 + 19, 5050), 125), 0.5)
    assert (numbered.index[0], numbered.unsure) == (5003, 0)


def test_an_impossible_counter() -> None:
    """A counter that has not risen by a multiple of its step is an error that says so."""
    numbering = stim(125)
    numbering.number(np.array([16, 32], np.uint8), 1.0)
    with pytest.raises(CounterError, match="went from 32 to 57, where it rises by 16 a sample"):
        numbering.number(np.array([57], np.uint8), 1.1)


def test_parts() -> None:
    """Blocks end at gaps, at changes of status, and when they are long enough; each knows what is missing before it."""
    numbered = Numbered(np.array([2, 3, 4, 5, 6, 9, 10, 11]), unsure=5)
    status = np.array([0, 0, 0, 0, 0, 0, 0, 4], np.uint8)
    assert parts(numbered, status, expected=1, longest=3) == [
        Part(slice(0, 3), 2, 1, unsure=False),
        Part(slice(3, 5), 5, 0, unsure=False),
        Part(slice(5, 7), 9, 2, unsure=True),
        Part(slice(7, 8), 11, 0, unsure=False),
    ]
    kept = numbered.only(np.array([True, True, False, True, True, False, True, True]))
    assert (kept.index.tolist(), kept.unsure) == ([2, 3, 5, 6, 10, 11], 4)
