"""From blocks of samples to mean rates over short intervals, the same for a live measurement and for a record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.api import GyroStatus, RateBlock
from northfinder.errors import EstimateError
from northfinder.estimation.means import RateMeans, concatenate, from_samples
from northfinder.record import DwellSpan, Record
from northfinder.record.block_columns import BlockColumns, columns_of_blocks

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
        found = list(blocks)
        self.add_columns(span, columns_of_blocks(found) if found else None)

    def add_columns(self, span: DwellSpan, columns: BlockColumns | None) -> None:
        """Add a finished dwell from its blocks as columns, None if there are none."""
        samples_per_mean = max(1, round(MEAN_INTERVAL * span.sample_rate))
        n_found = 0
        for run in _unbroken_runs(span, columns):
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
                    tilt=_mean_tilt(run.blocks),
                    specific_force=_specific_force(run, samples_per_mean),
                    dwell=span.step,
                    stream_start=span.stream_start,
                    turn_on=span.turn_on,
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
    blocks: BlockColumns
    fit: bool


def _unbroken_runs(span: DwellSpan, columns: BlockColumns | None) -> Iterator[_Run]:
    """Yield the dwell's samples in runs without a gap, fit and unfit ones apart."""
    if columns is None:
        return
    fit = (columns.status & int(UNFIT)) == 0
    new_run = (columns.stop_index[:-1] != columns.first_index[1:]) | (fit[:-1] != fit[1:])
    edges = [0, *(np.flatnonzero(new_run) + 1).tolist(), len(fit)]
    for begin, end in pairwise(edges):
        run = columns.part(begin, end)
        origin = int(run.first_index[0])
        first, stop = max(span.first_index, origin), min(span.stop_index, int(run.stop_index[-1]))
        if first < stop:
            yield _Run(first, run.rate[first - origin : stop - origin], run, bool(fit[begin]))


def _mean_tilt(blocks: BlockColumns) -> tuple[float, float]:
    """Return the mean of the measured tilts, zero if there are none."""
    valid = ((blocks.status & int(GyroStatus.TILT_INVALID)) == 0) & ~np.isnan(blocks.tilt).any(axis=1)
    if not valid.any():
        return (0.0, 0.0)
    x, y = blocks.tilt[valid].mean(axis=0)
    return (float(x), float(y))


def _specific_force(run: _Run, samples_per_mean: int) -> NDArray[np.float64]:
    """Return the mean specific force of each mean, from the blocks whose middle lies in it, shape (n, 3).

    A mean without the middle of a block has that of the whole run; all are zero where nothing was measured.
    """
    n_means = -(-len(run.rate) // samples_per_mean)
    measured = ~np.isnan(run.blocks.specific_force).any(axis=1)
    if not measured.any():
        return np.zeros((n_means, 3))
    length = run.blocks.n_samples[measured]
    middle = run.blocks.first_index[measured] + length / 2.0
    force = run.blocks.specific_force[measured] * length[:, np.newaxis]
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
        reduction.add_columns(span, record.columns_of(span))
    return reduction
