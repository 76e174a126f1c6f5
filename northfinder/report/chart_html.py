"""Charts for the page: drawing in SVG that stretches with the page, ticks and names in HTML that keeps its size.

So a chart is read as well on a telephone as on paper. What is drawn here consists of numbers alone; every text goes
through the templates, which escape it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from northfinder.report.axes import Axis, axes_of
from northfinder.report.charts import Band, Chart, Intervals, Item, Levels, Line

Array = NDArray[np.float64]

#: Units of the drawing's own coordinates; it is stretched to whatever room there is.
WIDTH, HEIGHT = 2000, 1000
#: A tick nearer to an end than this part of the axis would lose its text.
_EDGE = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """One tick and its text."""

    percent: float
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A named part of the horizontal axis."""

    percent: float
    width: float
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Plot:
    """A chart as the template takes it."""

    chart: Chart
    paths: list[Markup]
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    marks: list[Stretch]
    legend: list[tuple[str, str]]  #: (role, label)


def plot(chart: Chart) -> Plot:
    """Return the chart ready for the template."""
    x, y = axes_of(chart)
    paths = [path for item in chart.items for path in _drawn(item, x, y)]
    legend = [(item.role, item.label) for item in chart.items if item.label]
    return Plot(
        chart=chart,
        paths=paths,
        x_ticks=_ticks(x),
        y_ticks=_ticks(y),
        marks=[
            Stretch(
                percent=100.0 * x.place(mark.start),
                width=100.0 * (x.place(mark.stop) - x.place(mark.start)),
                name=mark.name,
            )
            for mark in chart.marks
        ],
        legend=legend,
    )


def _ticks(axis: Axis) -> list[Tick]:
    places = [(axis.place(value), text) for value, text in axis.ticks()]
    return [Tick(percent=round(100.0 * at, 2), text=text) for at, text in places if -_EDGE <= at <= 1.0 + _EDGE]


def _drawn(item: Item, x: Axis, y: Axis) -> list[Markup]:
    """Return the SVG elements of an item: paths of whole numbers."""
    match item:
        case Line():
            data, kind = _polyline(_places(item.x, x, WIDTH), _places(item.y, y, HEIGHT)), "line"
        case Band():
            data, kind = (
                _area(_places(item.x, x, WIDTH), *(_places(v, y, HEIGHT) for v in (item.low, item.high))),
                "band",
            )
        case Levels():
            start, stop = _places(item.start, x, WIDTH), _places(item.stop, x, WIDTH)
            data, kind = _strokes(start, stop, _places(item.y, y, HEIGHT)), "level"
        case Intervals():
            across = _places(item.x, x, WIDTH)
            low, middle, high = (_places(item.y + k * item.half, y, HEIGHT) for k in (-1.0, 0.0, 1.0))
            whiskers = _verticals(across, low, high)
            return [
                Markup('<path class="line {}" d="{}"/>').format(item.role, whiskers),
                Markup('<path class="dot {}" d="{}"/>').format(item.role, _strokes(across, across, middle)),
            ]
    return [Markup('<path class="{} {}" d="{}"/>').format(kind, item.role, data)]


def _places(values: Array, axis: Axis, size: int) -> Array:
    """Return drawing coordinates, the vertical ones downward; nan stays nan, what is far outside comes to the edge."""
    with np.errstate(invalid="ignore", divide="ignore"):
        if axis.logarithmic:
            part = np.log(values / axis.low) / math.log(axis.high / axis.low)
        else:
            part = (values - axis.low) / (axis.high - axis.low)
    part = np.clip(part, -0.5, 1.5)
    return np.round(size * (part if size == WIDTH else 1.0 - part))


def _polyline(x: Array, y: Array) -> str:
    pen, parts = "M", []
    for across, down in zip(x.tolist(), y.tolist(), strict=True):
        if math.isnan(across) or math.isnan(down):
            pen = "M"
            continue
        parts.append(f"{pen}{across:.0f} {down:.0f}")
        pen = "L"
    return "".join(parts)


def _area(x: Array, low: Array, high: Array) -> str:
    held = np.isfinite(low) & np.isfinite(high)
    x, low, high = x[held], low[held], high[held]
    if not x.size:
        return ""
    return _polyline(np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]])) + "Z"


def _strokes(start: Array, stop: Array, y: Array) -> str:
    rows = zip(start.tolist(), stop.tolist(), y.tolist(), strict=True)
    return "".join(f"M{a:.0f} {at:.0f}H{b:.0f}" for a, b, at in rows if not math.isnan(at))


def _verticals(x: Array, low: Array, high: Array) -> str:
    rows = zip(x.tolist(), low.tolist(), high.tolist(), strict=True)
    return "".join(f"M{at:.0f} {a:.0f}V{b:.0f}" for at, a, b in rows if not math.isnan(a))
