"""From blocks of samples to mean rates over short intervals, the same for a live measurement and for a record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.api import GyroStatus, RateBlock
from northfinder.errors import EstimateError
from northfinder.estimation.means import RateMeans, concatenate, from_samples
from northfinder.record import DwellSpan, Record

#: Length of the means, in s: short against every drift of a gyro, long against its angle noise.
MEAN_INTERVAL = 1.0

#: Samples of a block with any of these must not be used.
UNFIT = GyroStatus.NOT_READY | GyroStatus.SATURATED | GyroStatus.SENSOR_FAULT | GyroStatus.TEMPERATURE


@dataclass(slots=True)
class Reduction:
    """The means of all dwells so far."""

    n_unfit: int = 0  #: samples in dwells that the gyro itself declared unfit
    n_missing: int = 0  #: samples in dwells that never came
    _parts: list[RateMeans] = field(default_factory=list)

    def add(self, span: DwellSpan, blocks: Iterable[RateBlock]) -> None:
        """Add a finished dwell from the blocks that hold its samples."""
        samples_per_mean = max(1, round(MEAN_INTERVAL * span.sample_rate))
        n_found = 0
        for run in _unbroken_runs(span, blocks):
            n_found += len(run.rate)
            if not run.fit:
                self.n_unfit += len(run.rate)
                continue
            self._parts.append(
                from_samples(
                    run.rate,
                    run.first_index,
                    span.sample_rate,
                    samples_per_mean=samples_per_mean,
                    azimuth=span.measured_azimuth,
                    elevation=span.measured_elevation,
                    tilt=run.tilt,
                    specific_force=_specific_force(run, samples_per_mean),
                    dwell=span.step,
                )
            )
        self.n_missing += span.stop_index - span.first_index - n_found

    def means(self) -> RateMeans:
        """Return the means in order of time. Raises EstimateError if there are none."""
        if not self._parts:
            raise EstimateError("no dwell was finished with samples fit for use")
        return concatenate(self._parts)


@dataclass(frozen=True, slots=True)
class _Run:
    first_index: int
    rate: NDArray[np.float64]
    tilt: tuple[float, float]
    blocks: tuple[RateBlock, ...]
    fit: bool


def _unbroken_runs(span: DwellSpan, blocks: Iterable[RateBlock]) -> Iterator[_Run]:
    """Yield the dwell's samples in runs without a gap, fit and unfit ones apart."""
    run: list[RateBlock] = []
    for block in blocks:
        if run and (_end(run[-1]) != block.first_index or _fit(run[-1]) != _fit(block)):
            yield from _cut(span, run)
            run = []
        run.append(block)
    if run:
        yield from _cut(span, run)


def _cut(span: DwellSpan, run: list[RateBlock]) -> Iterator[_Run]:
    """Yield what of the run lies within the dwell, if anything."""
    begin = run[0].first_index
    first, stop = max(span.first_index, begin), min(span.stop_index, _end(run[-1]))
    if first < stop:
        rate = np.concatenate([block.rate for block in run])[first - begin : stop - begin]
        yield _Run(first, rate, _mean_tilt(run), tuple(run), _fit(run[0]))


def _end(block: RateBlock) -> int:
    return block.first_index + len(block.counts)


def _fit(block: RateBlock) -> bool:
    return not block.status & UNFIT


def _mean_tilt(run: list[RateBlock]) -> tuple[float, float]:
    """Return the mean of the measured tilts, zero if there are none."""
    tilts = [block.tilt for block in run if block.tilt is not None and not block.status & GyroStatus.TILT_INVALID]
    if not tilts:
        return (0.0, 0.0)
    x, y = np.mean(tilts, axis=0)
    return (float(x), float(y))


def _specific_force(run: _Run, samples_per_mean: int) -> NDArray[np.float64]:
    """Return the mean specific force of each mean, from the blocks whose middle lies in it, shape (n, 3).

    A mean without the middle of a block has that of the whole run; all are zero where nothing was measured.
    """
    n_means = -(-len(run.rate) // samples_per_mean)
    measured = [block for block in run.blocks if block.specific_force is not None]
    if not measured:
        return np.zeros((n_means, 3))
    length = np.array([len(block.counts) for block in measured])
    middle = np.array([block.first_index for block in measured]) + length / 2.0
    force = np.array([block.specific_force for block in measured]) * length[:, np.newaxis]
    number = ((middle - run.first_index) // samples_per_mean).astype(np.int64)
    inside = (number >= 0) & (number < n_means) & (middle < run.first_index + len(run.rate))
    weight = np.bincount(number[inside], length[inside], n_means)
    total = np.column_stack([np.bincount(number[inside], column[inside], n_means) for column in force.T])
    whole = force.sum(axis=0) / length.sum()
    return np.asarray(np.where(weight[:, np.newaxis] > 0.0, total / np.maximum(weight, 1.0)[:, np.newaxis], whole))


def reduce_record(record: Record) -> Reduction:
    """Reduce all finished dwells of a record. Raises RecordError."""
    reduction = Reduction()
    for span in record.steps():
        reduction.add(span, record.blocks_of(span))
    return reduction
