"""What is drawn, apart from how: charts as plain data, which `chart_html` and `figures` turn into pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from northfinder.estimation import NoiseModel, RateMeans
from northfinder.estimation.allan import averaging_factors, degrees_of_freedom, overlapping_allan_deviation
from northfinder.estimation.quantiles import chi_square
from northfinder.report.gather import Dwell, RecordReport
from northfinder.report.series import Series, thinned
from northfinder.text import printable
from northfinder.units import ARCSEC, DPH

Array = NDArray[np.float64]

#: Dwells that are drawn one by one; of a longer measurement the first ones.
MAX_DWELLS = 48
#: Longest moving average drawn over a dwell, s, as published (docs/method.md, section 2).
AVERAGING_TIME = 60.0
#: Steps are named in a chart of time if there are no more of them, else numbered as far as they are drawn one by one.
_MAX_NAMES = 12
#: Part of a chart's width that a letter needs, on paper as well.
_LETTER = 0.0105
_MINUTE = 60.0
#: Means in a row that give an Allan deviation worth drawing.
_SHORTEST_RUN = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """Points joined by a line; a nan breaks it."""

    x: Array
    y: Array
    role: str  #: what it is, for its colour: "one" to "three", "accent", "faint", "model"
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Band:
    """The area between two lines."""

    x: Array
    low: Array
    high: Array
    role: str
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levels:
    """Horizontal strokes, each from `start` to `stop`."""

    start: Array
    stop: Array
    y: Array
    role: str
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Intervals:
    """Points with the interval that was stated for each."""

    x: Array
    y: Array
    half: Array
    role: str
    label: str = ""


Item = Line | Band | Levels | Intervals


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A stretch of the horizontal axis with a name."""

    start: float
    stop: float
    name: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """One picture: what to draw on which axes."""

    name: str  #: for --part
    title: str
    x_label: str
    y_label: str
    items: tuple[Item, ...]
    note: str = ""  #: what to see in it, in a sentence
    marks: tuple[Mark, ...] = ()
    logarithmic: bool = False  #: both axes
    angles: bool = False  #: whether the vertical axis is of angles in deg, with ticks at parts of a circle
    directions: bool = False  #: whether the vertical axis is of directions in deg, which end at 360
    numbered: bool = False  #: whether the horizontal axis counts something, in whole numbers
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    height: float = 1.0  #: relative to the others


_ROLES = ("one", "two", "three")


def _axis_names(n_axes: int) -> list[str]:
    return [""] if n_axes == 1 else [f"axis {i + 1}" for i in range(n_axes)]


def charts(report: RecordReport) -> list[Chart]:
    """Return the charts of a record against time, and the Allan deviation of its residuals, as far as there are any."""
    made = [rate_chart(report), *residual_charts(report), *stage_charts(report), *environment_charts(report)]
    return [chart for chart in made if chart is not None]


def _marks(report: RecordReport) -> tuple[Mark, ...]:
    """Return the dwells as marks, in minutes, named where there is room; numbered where few names find room."""
    total = max((dwell.stop for dwell in report.dwells), default=0.0)
    names = [printable(dwell.span.name) for dwell in report.dwells]
    numbers = [str(number) for number in range(1, len(names) + 1)]
    named, numbered = (_fitting(each, report.dwells, total) for each in (names, numbers))
    few = 2 * sum(map(bool, named)) < len(named) or len(named) > _MAX_NAMES
    shown = named if not few else numbered if len(named) <= MAX_DWELLS else [""] * len(named)
    return tuple(
        Mark(start=dwell.start / _MINUTE, stop=dwell.stop / _MINUTE, name=name)
        for dwell, name in zip(report.dwells, shown, strict=True)
    )


def _fitting(names: Sequence[str], dwells: Sequence[Dwell], total: float) -> list[str]:
    """Return the names, empty where a dwell is too short for its name in a chart of `total` s."""
    room = [(dwell.stop - dwell.start) / (_LETTER * total) for dwell in dwells]
    return [name if len(name) <= letters else "" for name, letters in zip(names, room, strict=True)]


def _time_range(report: RecordReport) -> tuple[float, float] | None:
    """Return from the start of the samples to the end of the last dwell, in minutes."""
    return (0.0, max(mark.stop for mark in _marks(report))) if report.dwells else None


def rate_chart(report: RecordReport) -> Chart | None:
    """Return the mean rate of each second and of each dwell against time (fig. 3 of [S2])."""
    means = report.means
    if means is None:
        return None
    dwells = means.per_dwell()
    items: list[Item] = []
    for axis, name in enumerate(_axis_names(means.n_axes)):
        seconds = broken(means.middle / _MINUTE, means.rate[:, axis] / DPH, means.dwell)
        items.append(Line(x=seconds[0], y=seconds[1], role="faint", label="" if axis else "means of 1 s"))
        items.append(
            Levels(
                start=dwells.start / _MINUTE,
                stop=(dwells.start + dwells.duration) / _MINUTE,
                y=dwells.rate[:, axis] / DPH,
                role="accent" if means.n_axes == 1 else _ROLES[axis],
                label=f"mean of each dwell{name and ', '}{name}",
            )
        )
    return Chart(
        name="rate",
        title="Rate against time",
        x_label="time, min",
        y_label="rate, deg/h",
        items=tuple(items),
        marks=_marks(report),
        x_range=_time_range(report),
        note="Each dwell is shaded. What they differ by is the earth's rotation about the input axis; "
        "what they have in common is the bias.",
        height=1.15,
    )


def broken(x: Array, y: Array, group: NDArray[np.int64], *, n_columns: int = 700) -> tuple[Array, Array]:
    """Return a line that is broken between groups, thinned to what a picture shows."""
    edges = np.flatnonzero(np.diff(group)) + 1
    parts_x: list[ArrayLike] = []
    parts_y: list[ArrayLike] = []
    for part in np.split(np.arange(len(x)), edges):
        columns = max(2, round(n_columns * len(part) / len(x)))
        thin_x, thin_y = thinned(x[part], y[part], n_columns=columns)
        parts_x += [thin_x, [math.nan]]
        parts_y += [thin_y, [math.nan]]
    return np.concatenate(parts_x[:-1]), np.concatenate(parts_y[:-1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DwellPair:
    """One dwell without and with averaging, about its mean, deg/h against s."""

    number: int
    dwell: Dwell
    mean: Array  #: (n_axes,) deg/h
    raw: Chart
    averaged: Chart
    window: float  #: s of the moving average


def dwell_pairs(report: RecordReport) -> list[DwellPair]:
    """Return each dwell's samples, and its means of 1 s with their moving average (fig. 4 and 5 of [S2]).

    All have the same axes, so that they can be compared; of a longer measurement only the first MAX_DWELLS.
    """
    means = report.means
    if means is None:
        return []
    pairs = []
    for number, dwell in enumerate(report.dwells[:MAX_DWELLS], start=1):
        own = means.dwell == dwell.span.step
        if own.any():
            pairs.append(_dwell_pair(number, dwell, means.select(own)))
    raw_limit = max((float(np.max(np.abs(_ends(pair.raw)))) for pair in pairs), default=1.0)
    averaged_limit = max((float(np.max(np.abs(_ends(pair.averaged)))) for pair in pairs), default=1.0)
    return [
        DwellPair(
            number=pair.number, dwell=pair.dwell, mean=pair.mean, window=pair.window,
            raw=_with_limit(pair.raw, raw_limit), averaged=_with_limit(pair.averaged, averaged_limit),
        )
        for pair in pairs
    ]  # fmt: skip


def _ends(chart: Chart) -> Array:
    values = [(item.low, item.high) if isinstance(item, Band) else (item.y,) for item in chart.items]
    return np.concatenate([part[np.isfinite(part)] for each in values for part in each])


def _with_limit(chart: Chart, limit: float) -> Chart:
    return Chart(
        name=chart.name, title=chart.title, x_label=chart.x_label, y_label=chart.y_label, items=chart.items,
        x_range=chart.x_range, y_range=(-1.08 * limit, 1.08 * limit),
    )  # fmt: skip


def _dwell_pair(number: int, dwell: Dwell, means: RateMeans) -> DwellPair:
    span, first = dwell.span, dwell.span.first_index
    weight = means.duration / means.duration.sum()
    mean = weight @ means.rate
    window = min(AVERAGING_TIME, max(2.0, span.dwell / 4.0))
    raw: list[Item] = []
    averaged: list[Item] = []
    for axis, name in enumerate(_axis_names(means.n_axes)):
        role = _ROLES[axis]
        low, high = ((values[:, axis] - mean[axis]) / DPH for values in (dwell.raw.low, dwell.raw.high))
        raw.append(Band(x=(dwell.raw.x - first) / span.sample_rate, low=low, high=high, role=role, label=name))
        seconds = means.middle - dwell.start
        off = (means.rate[:, axis] - mean[axis]) / DPH
        averaged.append(Line(x=seconds, y=off, role="faint", label="" if axis else "means of 1 s"))
        middle, smooth = moving_average(seconds, off, window)
        averaged.append(Line(x=middle, y=smooth, role=role, label="moving average"))
    length = (span.stop_index - first) / span.sample_rate
    title = f"{number} {span.name}"
    return DwellPair(
        number=number,
        dwell=dwell,
        mean=mean / DPH,
        window=window,
        raw=Chart(name="raw", title=title, x_label="s", y_label="deg/h", items=tuple(raw), x_range=(0.0, length)),
        averaged=Chart(
            name="averaged", title=title, x_label="s", y_label="deg/h", items=tuple(averaged), x_range=(0.0, length)
        ),
    )


def moving_average(x: Array, y: Array, window: float) -> tuple[Array, Array]:
    """Return the means of places and values over as many values as `window` says, none that reach beyond an end.

    >>> moving_average(np.arange(4.0), np.arange(4.0), 2.0)[0].tolist()
    [0.5, 1.5, 2.5]
    """
    n = max(1, round(window))
    if len(y) < n:
        return np.zeros(0), np.zeros(0)
    x, y = (np.convolve(each, np.full(n, 1.0 / n), mode="valid") for each in (x, y))
    return x, y


def residual_charts(report: RecordReport) -> list[Chart | None]:
    """Return what the model leaves over, against time and as Allan deviation."""
    fix, used = report.fix, report.used
    if fix is None or used is None:
        return []
    items: list[Item] = []
    for axis, name in enumerate(_axis_names(used.n_axes)):
        x, y = broken(used.middle / _MINUTE, fix.residuals[:, axis] / DPH, used.dwell)
        items.append(Line(x=x, y=y, role=_ROLES[axis], label=name))
    widened = f" The stated intervals were widened {fix.rescaled_by:.2f} times." if fix.rescaled_by > 1.0 else ""
    left_out = f" {fix.n_rejected} more were disturbed and left out." if fix.n_rejected else ""
    over_time = Chart(
        name="residuals",
        title="Residuals",
        x_label="time, min",
        y_label="deg/h",
        items=tuple(items),
        marks=_marks(report),
        x_range=_time_range(report),
        note=f"What the model leaves of {fix.n_means:,} means.{left_out}{widened}",
        height=0.8,
    )
    return [over_time, allan_chart(used.with_rate(fix.residuals), report.noise)]


def allan_chart(residuals: RateMeans, noise: NoiseModel | None) -> Chart | None:
    """Return the Allan deviation of residuals within dwells, with what the noise model makes one expect.

    The squares of all unbroken runs are put together, weighted by how many each gives; None if there are too few.
    """
    pooled = pooled_allan(residuals, noise)
    if pooled is None:
        return None
    tau = pooled.tau
    items: list[Item] = []
    if noise is not None:
        label = "95 % of what the noise model predicts"
        items.append(Band(x=tau, low=pooled.low, high=pooled.high, role="model", label=label))
    for axis, name in enumerate(_axis_names(residuals.n_axes)):
        label = name or "residuals within dwells"
        items.append(Line(x=tau, y=pooled.deviation[:, axis], role=_ROLES[axis], label=label))
    return Chart(
        name="allan",
        title="Allan deviation of the residuals",
        x_label="averaging time, s",
        y_label="deg/h",
        items=tuple(items),
        logarithmic=True,
        note="Within the band the gyro behaved as the noise model says.",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PooledAllan:
    """Allan deviation of all unbroken runs together, and what to expect of it; deg/h against s."""

    tau: Array  #: (k,)
    deviation: Array  #: (k, n_axes)
    low: Array  #: (k,) ends of the 95 % band of the noise model, nan without one
    high: Array


def pooled_allan(residuals: RateMeans, noise: NoiseModel | None) -> PooledAllan | None:
    """Return the Allan deviation within the runs of `residuals` that have no gap, None if all are too short."""
    breaks = np.flatnonzero((residuals.gap != 0.0) | (np.diff(residuals.dwell) != 0)) + 1
    runs = [run for run in np.split(np.arange(residuals.n), breaks) if len(run) >= _SHORTEST_RUN]
    if not runs:
        return None
    period = float(np.median(residuals.duration))
    factors = averaging_factors(max(len(run) for run in runs))
    total = np.zeros((len(factors), residuals.n_axes))
    weight, edf = np.zeros(len(factors)), np.zeros(len(factors))
    for run in runs:
        fitting = factors[2 * factors <= len(run)]
        k, terms = len(fitting), len(run) + 1 - 2 * fitting
        found = np.column_stack([overlapping_allan_deviation(rate, fitting) for rate in residuals.rate[run].T])
        total[:k] += terms[:, None] * found**2
        weight[:k] += terms
        if noise is not None:
            edf[:k] += [degrees_of_freedom(noise, len(run), m, period) for m in fitting.tolist()]
    tau = np.asarray(factors * period, dtype=np.float64)
    expected = np.full(len(tau), math.nan) if noise is None else noise.allan_deviation(tau) / DPH
    low, high = (
        expected * np.sqrt([chi_square(tail, max(1, round(n))) / max(1, round(n)) for n in edf.tolist()])
        for tail in (0.975, 0.025)
    )
    return PooledAllan(tau=tau, deviation=np.sqrt(total / weight[:, None]) / DPH, low=low, high=high)


def stage_charts(report: RecordReport) -> list[Chart | None]:
    """Return the stage's angles against time."""
    path = report.stage
    if path is None:
        return []
    items = [
        Line(x=path.time / _MINUTE, y=np.degrees(angle), role=role, label=name)
        for name, angle, role in (("azimuth", path.azimuth, "one"), ("elevation", path.elevation, "two"))
    ]
    return [
        Chart(
            name="stage",
            title="Stage angles",
            x_label="time, min",
            y_label="deg",
            items=tuple(items),
            marks=_marks(report),
            x_range=_time_range(report),
            angles=True,
            height=0.8,
        )
    ]


def environment_charts(report: RecordReport) -> list[Chart | None]:
    """Return tilt and temperature against time, where they were measured."""
    made: list[Chart | None] = []
    if report.tilt is not None:
        names = (("toward stage azimuth 0", "one"), ("toward stage azimuth 90", "two"))
        tilt = Series(report.tilt.x, *(each / ARCSEC for each in (report.tilt.low, report.tilt.mean, report.tilt.high)))
        items = [_slow_line(report, tilt, i, role, name) for i, (name, role) in enumerate(names)]
        made.append(_small("tilt", "Tilt", "arcsec", items, report))
    if report.temperature is not None:
        made.append(
            _small("temperature", "Temperature", "°C", [_slow_line(report, report.temperature, 0, "one")], report)
        )
    return made


def _slow_line(report: RecordReport, series: Series, column: int, role: str, label: str = "") -> Line:
    """Return a line that is broken between dwells, where nothing was measured."""
    dwells = report.dwells[:MAX_DWELLS]
    group = np.searchsorted([dwell.start for dwell in dwells], series.x) - 1
    # What was put together from the end of a dwell and the begin of the next stands between them, and is not drawn.
    inside = series.x <= np.array([*(dwell.stop for dwell in dwells[:-1]), math.inf])[group]
    x, y = broken(series.x[inside] / _MINUTE, series.mean[inside, column], group[inside])
    return Line(x=x, y=y, role=role, label=label)


def _small(name: str, title: str, unit: str, items: Sequence[Item], report: RecordReport) -> Chart:
    return Chart(
        name=name,
        title=title,
        x_label="time, min",
        y_label=unit,
        items=tuple(items),
        x_range=_time_range(report),
        marks=_marks(report) if len(report.dwells) > _MAX_NAMES else (),
        height=0.6,
    )
