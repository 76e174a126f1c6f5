"""Everything a report shows of one record, read in memory that does not grow with the record."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.api import DeviceIdentity, GyroStatus
from northfinder.errors import EstimateError, RecordError
from northfinder.estimation import Fix, NoiseModel, RateMeans
from northfinder.geodesy import Place
from northfinder.record import DwellSpan, Record
from northfinder.record.block_columns import BlockColumns
from northfinder.record.facts import completeness
from northfinder.reduction import Reduction
from northfinder.report.series import Envelope, Series
from northfinder.solution import Assumptions, Problem, fix_to_json, solve, supplement
from northfinder.solve_file import kept_assumptions, kept_bearings

Array = NDArray[np.float64]

#: Stretches of a dwell's samples that are drawn, and of the whole measurement's tilt and temperature.
DWELL_BINS = 96
_BLOCK_BINS = 512
#: Samples that are worked on at once.
_BATCH_SAMPLES = 1 << 16
#: States of the stage that are drawn, and events that are listed.
_MAX_STATES = 3000
MAX_EVENTS = 200
#: No sample rate, time or angle of a measurement is as large, in SI.
_UNHEARD_OF = 1e9
#: Events that are the course of every measurement and tell nothing by themselves.
_ROUTINE = {"state"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dwell:
    """A finished dwell as it was sampled, before anything was left out; its averages are among the means."""

    span: DwellSpan
    n_samples: int  #: found in the record
    raw: Series  #: rad/s, against the sample's index
    mean: Array  #: (n_axes,) rad/s, of all samples
    raw_sd: Array  #: (n_axes,) rad/s, of single samples about the dwell's mean

    @property
    def start(self) -> float:
        """Time of its first sample, s."""
        return self.span.stream_start + self.span.first_index / self.span.sample_rate

    @property
    def stop(self) -> float:
        """Time at which its last sample ended, s."""
        return self.span.stream_start + self.span.stop_index / self.span.sample_rate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StagePath:
    """Where the stage was; by the gyro's samples' time."""

    time: Array  #: (n,) s
    azimuth: Array  #: (n,) rad
    elevation: Array  #: (n,) rad


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordReport:
    """What is to be said of one record."""

    path: Path
    result: dict[str, Any]  #: as `solve` gives it, with bearings; without a fix only what the record is
    failure: str  #: why there is no fix, empty if there is one
    fix: Fix | None
    interval: float  #: how many standard deviations make the 95 % interval
    assumptions: Assumptions | None
    means: RateMeans | None  #: of all dwells
    used: RateMeans | None  #: those that the estimator was given, in the order of the fix's residuals
    noise: NoiseModel | None
    dwells: tuple[Dwell, ...]
    temperature: Series | None  #: degrees Celsius, against s
    tilt: Series | None  #: rad, two columns, against s
    stage: StagePath | None
    started: float | None  #: s since 1970, UTC
    ended: float | None
    identities: dict[str, DeviceIdentity]
    meta: dict[str, Any]  #: software version, plan, configuration, simulation, sample rate
    events: tuple[tuple[float, str, str], ...]  #: those worth telling, the first MAX_EVENTS
    n_events: int  #: of those worth telling
    n_unfit: int = 0
    n_missing: int = 0
    n_streams: int = 1  #: one more than the measurement was interrupted and resumed

    @property
    def truth(self) -> tuple[float, float] | None:
        """The emulator's azimuth and latitude, deg; None on a real bench."""
        table = self.meta.get("simulation")
        try:
            return float(table["azimuth_deg"]), float(table["latitude_deg"])  # type: ignore[index]
        except (TypeError, KeyError, ValueError):
            return None


def gather_record(path: Path, place: Place | None = None) -> RecordReport:
    """Read the record at `path`, estimate as `solve` does, and say what it is on a map if a place is given or kept.

    Raises RecordError. Data that determine no azimuth are no failure: `RecordReport.failure` says why.
    """
    with Record(path) as record:
        watch, reduction = _Watch(), Reduction()
        for span in record.steps():
            _require_possible(record, span)
            columns = record.columns_of(span)
            reduction.add_columns(span, columns)
            if columns is not None:
                watch.follow(span, columns)
        events = record.events()
        estimate = _estimate(record, reduction, place)
        told = [event for event in events if event[1] not in _ROUTINE]
        return RecordReport(
            path=path,
            dwells=tuple(watch.dwells),
            temperature=watch.temperature.series(),
            tilt=watch.tilt.series(),
            stage=_stage_path(record, [dwell.span for dwell in watch.dwells]),
            started=events[0][0] if events else None,
            ended=events[-1][0] if events else None,
            identities=_identities(record),
            meta={name: record.meta(name) for name in ("northfinder", "plan", "config", "simulation", "sample_rate")},
            events=tuple(told[:MAX_EVENTS]),
            n_events=len(told),
            n_streams=record.count("stream"),
            **estimate,
        )


def _require_possible(record: Record, span: DwellSpan) -> None:
    """Raise RecordError for a dwell that cannot have been: a record may come from anywhere."""
    times = (span.stream_start, span.dwell, span.measured_azimuth, span.measured_elevation)
    possible = 0.0 < span.sample_rate < _UNHEARD_OF and all(abs(each) < _UNHEARD_OF for each in times)
    if not (possible and 0 <= span.first_index < span.stop_index):
        raise RecordError(f"the record {record.path} is damaged: dwell {span.step} has no possible time or position")


def _estimate(record: Record, reduction: Reduction, place: Place | None) -> dict[str, Any]:
    """Return the fields that follow from the fix, as far as there is one."""
    plan = record.meta("plan")
    name = plan.get("name") if isinstance(plan, dict) else None
    about = {"plan": name, "record": str(record.path)} | completeness(record)
    assumptions, means = None, None
    found: dict[str, Any] = {"fix": None, "used": None, "noise": None, "interval": math.nan, "failure": ""}
    try:
        assumptions = kept_assumptions(record)
        means = reduction.means()
        fix = solve(means, assumptions)
        problem = Problem.of(means, assumptions)
        found |= {"fix": fix, "used": problem.means, "noise": problem.noise, "interval": fix.coverage_factor()}
        result = fix_to_json(fix) | supplement(means, assumptions, fix) | about
        result |= kept_bearings(record, result, place)
    except EstimateError as error:
        found["failure"], result = str(error), about
    counts = {"n_unfit": reduction.n_unfit, "n_missing": reduction.n_missing}
    return found | counts | {"assumptions": assumptions, "means": means, "result": result}


def _identities(record: Record) -> dict[str, DeviceIdentity]:
    try:
        return msgspec.convert(record.meta("identities") or {}, dict[str, DeviceIdentity])
    except msgspec.ValidationError as error:
        raise RecordError(f"the record {record.path} is damaged: its identities cannot be read: {error}") from None


class _Slow:
    """What stands beside the samples, against time, in bounded memory."""

    def __init__(self, n_columns: int) -> None:
        # One column more than the values: the time, so that each stretch has the mean of its own.
        self._envelope = Envelope(1 + n_columns, n_bins=_BLOCK_BINS)
        self._n = 0

    def add(self, time: Array, values: Array) -> None:
        """Take values (n, n_columns) at the times (n,); those that were not measured are nan."""
        held = ~np.isnan(values).any(axis=1)
        self._envelope.add(self._n, np.column_stack([time[held], values[held]]))
        self._n += int(held.sum())

    def series(self) -> Series | None:
        """Return what there is, None if nothing was measured."""
        if not self._n:
            return None
        kept = self._envelope.series()
        return Series(kept.mean[:, 0], kept.low[:, 1:], kept.mean[:, 1:], kept.high[:, 1:])


class _Watch:
    """Looks at the blocks of all dwells once, and keeps what is drawn of them."""

    def __init__(self) -> None:
        self.dwells: list[Dwell] = []
        self.temperature, self.tilt = _Slow(1), _Slow(2)

    def follow(self, span: DwellSpan, columns: BlockColumns) -> None:
        """Look at one dwell."""
        time = span.stream_start + (columns.first_index + columns.n_samples / 2.0) / span.sample_rate
        self.temperature.add(time, columns.temperature[:, np.newaxis])
        valid = (columns.status & int(GyroStatus.TILT_INVALID)) == 0
        self.tilt.add(time[valid], columns.tilt[valid])
        width = -(-(span.stop_index - span.first_index) // DWELL_BINS)
        envelope = Envelope(columns.counts.shape[1], n_bins=DWELL_BINS, first=span.first_index, width=width)
        moments: _Moments | None = None
        for first, rate in _pieces(span, columns):
            moments = moments or _Moments(rate[0])
            envelope.add(first, rate)
            moments.add(rate)
        if moments is not None:
            raw = envelope.series()
            dwell = Dwell(span=span, n_samples=moments.n, raw=raw, mean=moments.mean(), raw_sd=moments.sd())
            self.dwells.append(dwell)


def _pieces(span: DwellSpan, columns: BlockColumns) -> Iterator[tuple[int, Array]]:
    """Yield (index of the first sample, rates in rad/s) of the dwell's samples, in unbroken pieces of some size."""
    broken = columns.stop_index[:-1] != columns.first_index[1:]
    size = np.cumsum(columns.n_samples)
    full = np.diff(size // _BATCH_SAMPLES) != 0
    edges = [0, *(np.flatnonzero(broken | full) + 1).tolist(), len(size)]
    for begin, end in pairwise(edges):
        part = columns.part(begin, end)
        origin = int(part.first_index[0])
        first, stop = max(span.first_index, origin), min(span.stop_index, int(part.stop_index[-1]))
        if first < stop:
            yield first, part.rate[first - origin : stop - origin]


class _Moments:
    """Count, mean and standard deviation of samples that come in batches; about the first, so that none cancels."""

    def __init__(self, origin: Array) -> None:
        self.origin = origin
        self.n = 0
        self._sum = np.zeros_like(origin)
        self._squares = np.zeros_like(origin)

    def add(self, values: Array) -> None:
        off = values - self.origin
        self.n += len(off)
        self._sum += off.sum(axis=0)
        self._squares += np.einsum("ij,ij->j", off, off)

    def mean(self) -> Array:
        return np.asarray(self.origin + self._sum / self.n)

    def sd(self) -> Array:
        variance = (self._squares - self._sum**2 / self.n) / max(1, self.n - 1)
        return np.sqrt(np.maximum(variance, 0.0))


def _stage_path(record: Record, spans: list[DwellSpan]) -> StagePath | None:
    """Return where the stage was; its own clock is set to the gyro's by what arrived at the same time."""
    columns = [(row[1], row[2], row[3], row[5], row[6]) for row in record.rows("stage_state")]
    if not columns or not spans:
        return None
    stream, time, arrival, azimuth, elevation = np.array(columns, dtype=np.float64).T
    shifted = np.full(len(time), np.nan)
    for number in {span.stream for span in spans}:
        own = stream == number
        offsets = [
            span.stream_start
            + block.first_index / span.sample_rate
            - np.interp(block.arrival_time, arrival[own], time[own])
            for span in spans
            if span.stream == number and own.any()
            for block in islice(record.blocks_of(span), 1)
        ]
        if offsets:
            shifted[own] = time[own] + np.median(offsets)
    kept = np.flatnonzero(np.max(np.abs([shifted, azimuth, elevation]), axis=0) < _UNHEARD_OF)
    kept = kept[_corners(np.column_stack([azimuth, elevation])[kept])]
    return StagePath(time=shifted[kept], azimuth=azimuth[kept], elevation=elevation[kept]) if len(kept) else None


def _corners(angles: Array) -> NDArray[np.int64]:
    """Return which states draw the same path: those beside a change, thinned evenly if there are too many."""
    near = np.zeros(len(angles), dtype=np.bool_)
    if len(angles):
        moved = np.any(np.diff(angles, axis=0) != 0.0, axis=1)
        near[:-1] |= moved
        near[1:] |= moved
        near[[0, -1]] = True
    kept = np.flatnonzero(near)
    return kept[:: max(1, -(-len(kept) // _MAX_STATES))]
