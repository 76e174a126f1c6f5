"""A static rate recording from a file: a record of ours, CSV, or a NumPy archive; told apart by its content.

========  =================================================  ======================================================
file      rate                                               sample rate
========  =================================================  ======================================================
record    the longest dwell, or all of it if no dwell ended  the record's own
CSV       column with its unit, as ``rate_dph``              column ``time_s``, or as given
archive   array with its unit, as ``rate_dph``, or           ``sample_rate_hz``, array ``time_s``, or as given
          ``*_counts`` with ``dph_per_count`` beside it
========  =================================================  ======================================================

Units: ``dph`` (deg/h), ``deg_s``, ``rad_s``. A column or array without one needs a scale. Where samples are missing the
longest unbroken run is taken, for the noise of the angle crosses no gap; a note says so.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.api import RateBlock
from northfinder.archive import read_arrays
from northfinder.delimited import read_header, read_rows, shown
from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.reduction import UNFIT
from northfinder.text import printable
from northfinder.units import DPH

Array = NDArray[np.float64]

_UNITS = {"dph": DPH, "deg_s": math.radians(1.0), "rad_s": 1.0}
_SQLITE = b"SQLite format 3\0"
_ZIP = b"PK\x03\x04"
#: Two samples further apart than this many sample periods have others missing between them.
_GAP = 1.5
_SAMPLE_RATES = (1e-4, 1e7)  #: Hz
_MAX_RATE = 1e6  #: rad/s


@dataclass(frozen=True, slots=True, kw_only=True)
class RateSelection:
    """What to read from a recording; what is None is found in the file."""

    column: str | None = None  #: of CSV or an archive
    axis: int = 1  #: of a record or of an array with several, from 1
    sample_rate: float | None = None  #: Hz
    scale: float | None = None  #: rad/s in one unit of the column
    skip: float = 0.0  #: s left out at the start


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RateSeries:
    """Evenly spaced samples of one gyro at rest, without a gap."""

    rate: Array  #: rad/s, shape (n,)
    sample_rate: float  #: Hz
    notes: tuple[str, ...] = ()  #: what was left out, a sentence each

    @property
    def duration(self) -> float:
        """Length in s."""
        return self.rate.size / self.sample_rate


def read_rate_file(path: Path, selection: RateSelection) -> RateSeries:
    """Read the samples that `selection` asks for.

    Raises
    ------
    RecordError
        In one sentence: the file cannot be read, is none of the kinds, or does not hold what was asked for.
    """
    try:
        with path.open("rb") as file:
            begin = file.read(len(_SQLITE))
        if begin == _SQLITE:
            series = _from_record(path, selection)
        elif begin.startswith(_ZIP):
            series = _from_archive(path, selection)
        else:
            series = _from_csv(path, selection)
        return _skipped(series, selection.skip)
    except RecordError as error:
        name = printable(str(path))
        raise RecordError(str(error) if name in str(error) else f"{name}: {error}") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "no valid path"
        raise RecordError(f"{printable(str(path))}: cannot be read: {reason}") from None


def _skipped(series: RateSeries, skip: float) -> RateSeries:
    n = round(skip * series.sample_rate)
    if n >= series.rate.size:
        raise RecordError(f"lasts {series.duration:g} s, so nothing is left after skipping {skip:g} s")
    return replace(series, rate=series.rate[n:])


def _from_record(path: Path, selection: RateSelection) -> RateSeries:
    with Record(path) as record:
        dwell = max(record.steps(), key=lambda span: span.stop_index - span.first_index, default=None)
        sample_rate = selection.sample_rate or (dwell.sample_rate if dwell else record.meta("sample_rate"))
        if not isinstance(sample_rate, float | int):
            raise RecordError("does not say its sample rate: give it with --sample-rate")
        span = (dwell.first_index, dwell.stop_index) if dwell else (0, 1 << 62)
        blocks = [_block(block, selection.axis, *span) for block in record.blocks(*span)]
    fit = [(index, rate) for index, rate, fit in blocks if fit]
    if not fit:
        raise RecordError("holds no samples fit for use")
    rate = np.concatenate([rate for _, rate in fit])
    run = _longest_run(np.concatenate([index for index, _ in fit]).astype(np.float64), 1.0)
    return _series(rate, run, sample_rate)


def _block(block: RateBlock, axis: int, first: int, stop: int) -> tuple[NDArray[np.int64], Array, bool]:
    """Return index and rate of the block's samples from `first` to before `stop`, and whether they are fit for use."""
    rate = block.rate
    _check_axis(rate.shape[1], axis)
    index = block.first_index + np.arange(rate.shape[0])
    inside = (index >= first) & (index < stop)
    return index[inside], rate[inside, axis - 1], not block.status & UNFIT


def _check_axis(n_axes: int, axis: int) -> None:
    if not 1 <= axis <= n_axes:
        raise RecordError(f"there is no axis {axis}, expected 1 to {n_axes}")


def _from_csv(path: Path, selection: RateSelection) -> RateSeries:
    with path.open("rb") as file:
        header = read_header(file)
        name, scale = _choose(header.names, {}, selection)
        wanted = [header.names.index(name)]
        if selection.sample_rate is None:
            if "time_s" not in header.names:
                raise RecordError("has no column time_s: give the sample rate with --sample-rate")
            wanted.append(header.names.index("time_s"))
        columns = np.hstack([np.empty((len(wanted), 0)), *(part for _, part in read_rows(file, header, wanted))])
    return _timed(columns[0] * scale, None if selection.sample_rate else columns[1], selection.sample_rate)


def _from_archive(path: Path, selection: RateSelection) -> RateSeries:
    arrays = read_arrays(path)
    single = {name: float(array.reshape(-1)[0]) for name, array in arrays.items() if array.size == 1}
    name, scale = _choose(arrays, single, selection)
    rate = arrays[name]
    if rate.ndim == 2:  # samples by axes
        _check_axis(rate.shape[1], selection.axis)
        rate = rate[:, selection.axis - 1]
    if rate.ndim != 1:
        raise RecordError(f"array {shown(name)} has shape {rate.shape}, expected (n,) or (n, axes)")
    sample_rate = selection.sample_rate or single.get("sample_rate_hz")
    time = arrays.get("time_s")
    if sample_rate is None and (time is None or time.shape != rate.shape):
        raise RecordError(f"has neither sample_rate_hz nor {rate.size} of time_s: give the rate with --sample-rate")
    return _timed(rate * scale, None if sample_rate else time, sample_rate)


def _choose(names: Iterable[str], single: Mapping[str, float], selection: RateSelection) -> tuple[str, float]:
    """Return the name of the rate and what takes it to rad/s."""
    there = list(names)
    counts = [value * si for unit, si in _UNITS.items() if (value := single.get(f"{unit}_per_count")) is not None]
    scales = {name: si for name in there for unit, si in _UNITS.items() if name.endswith(f"_{unit}")}
    scales |= {name: counts[0] for name in there if name.endswith("_counts") and counts}
    wanted = [selection.column] if selection.column is not None else list(scales)
    listed = ", ".join(shown(name) for name in (wanted if len(wanted) > 1 else there)[:12])
    if len(wanted) != 1 or wanted[0] not in there:
        problem = f"has no {shown(wanted[0])}" if len(wanted) == 1 else f"has {len(wanted)} rates"
        units = ", ".join(f"_{unit}" for unit in _UNITS)
        raise RecordError(f"{problem}: name one with --column, with its unit at the end ({units}); found {listed}")
    scale = selection.scale or scales.get(wanted[0])
    if scale is None:
        raise RecordError(f"{shown(wanted[0])} names no unit: give deg/h in one of its steps with --scale")
    return wanted[0], scale


def _timed(rate: Array, time: Array | None, sample_rate: float | None) -> RateSeries:
    if sample_rate is not None:
        return _series(rate, slice(0, rate.size), sample_rate)
    assert time is not None  # noqa: S101  # one of both is there
    step = np.diff(time)
    if not np.all(step > 0.0):
        raise RecordError(f"time_s does not grow from sample {int(np.argmin(step > 0.0)) + 1} to the next")
    if step.size == 0:
        raise RecordError(f"holds {rate.size} samples, expected 2 or more")
    run = _longest_run(time, float(np.median(step)))
    if run.stop - run.start < 2:
        raise RecordError("has no two samples without a gap between them")
    return _series(rate, run, (run.stop - run.start - 1) / float(time[run.stop - 1] - time[run.start]))


def _longest_run(position: Array, step: float) -> slice:
    """Return where the longest run without a gap lies; `step` is the regular distance of two samples."""
    cuts = np.flatnonzero(np.diff(position) > _GAP * step) + 1
    edges = np.concatenate([[0], cuts, [position.size]])
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]), int(edges[longest + 1]))


def _series(rate: Array, run: slice, sample_rate: float) -> RateSeries:
    rate = np.asarray(rate, dtype=np.float64)
    if not _SAMPLE_RATES[0] <= sample_rate <= _SAMPLE_RATES[1]:
        raise RecordError(
            f"the sample rate is {sample_rate:g} Hz, expected {_SAMPLE_RATES[0]:g} to {_SAMPLE_RATES[1]:g}"
        )
    possible = np.abs(rate) <= _MAX_RATE  # false for what is no number
    if not possible.all():
        raise RecordError(
            f"sample {int(np.argmin(possible)) + 1} is {rate[np.argmin(possible)]:g} rad/s, no rate of a gyro"
        )
    taken, notes = rate[run], []
    if taken.size < rate.size:
        notes.append(
            f"samples are missing or unfit: the longest unbroken run is taken, {taken.size} of {rate.size} samples"
        )
    if np.count_nonzero(taken[1:] == taken[:-1]) > 0.5 * taken.size:
        notes.append("most samples equal the one before: the resolution of the output hides the noise")
    return RateSeries(rate=taken, sample_rate=sample_rate, notes=tuple(notes))
