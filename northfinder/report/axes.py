"""Where the ticks of an axis stand, and what they say."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from northfinder.angles import direction_text
from northfinder.report.charts import Band, Chart, Intervals, Item, Levels

#: Stretches between the ticks of an axis, at most.
_ACROSS, _UPWARD = 9, 6
#: Steps between angles in deg that are parts of a circle, and from which step on they are of use.
_CIRCLE, _FINE = (15.0, 30.0, 45.0, 90.0, 180.0, 360.0, 720.0, 1440.0), 10.0
#: Part of the vertical axis that is left to the names of steps.
_NAMES = 0.1


@dataclass(frozen=True, slots=True)
class Axis:
    """A range of values laid out from 0 to 1."""

    low: float
    high: float
    logarithmic: bool = False
    most: int = _UPWARD  #: stretches between ticks
    least_step: float = 0.0  #: between ticks
    angles: bool = False  #: ticks at parts of a circle, deg
    directions: bool = False  #: texts below 360 deg

    def place(self, value: float) -> float:
        """Return where `value` stands, 0 at the low end and 1 at the high one."""
        if self.logarithmic:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[tuple[float, str]]:
        """Return (value, text) of round values within the range."""
        if self.logarithmic:
            return _decades(self.low, self.high)
        return _multiples(self.low, self.high, self._step(), directions=self.directions)

    def _step(self) -> float:
        least = max((self.high - self.low) / self.most, self.least_step)
        fitting = [step for step in _CIRCLE if step >= least]
        return fitting[0] if self.angles and least > _FINE and fitting else _round_step(least)


def _round_step(least: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at least as large.

    >>> _round_step(2.7)
    5.0
    """
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * m for m in (1, 2, 5, 10) if power * m >= least)


def _multiples(low: float, high: float, step: float, *, directions: bool) -> list[tuple[float, str]]:
    """Return the multiples of a step.

    >>> [text for _, text in _multiples(359.7, 360.3, 0.2, directions=True)]
    ['359.8', '0.0', '0.2']
    """
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values = [k * step for k in range(first, last + 1)]
    if directions:
        return [(value, direction_text(value, decimals)) for value in values]
    return [(value, f"{value:z.{decimals}f}".replace("-", "−")) for value in values]


def _decades(low: float, high: float) -> list[tuple[float, str]]:
    """Return powers of ten, with 2 and 5 times them where there are few.

    >>> [text for _, text in _decades(0.7, 30.0)]
    ['1', '2', '5', '10', '20']
    """
    few = math.log10(high / low) < 2.5
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    values = [m * 10.0**power for power in powers for m in ((1, 2, 5) if few else (1,))]
    return [(value, f"{value:g}") for value in values if low <= value <= high]


def axes_of(chart: Chart) -> tuple[Axis, Axis]:
    """Return the horizontal and the vertical axis of a chart: as it says, or so that everything is seen."""
    x = chart.x_range or _range([_x(item) for item in chart.items], chart, margin=0.0)
    y = chart.y_range or _range([_y(item) for item in chart.items], chart, margin=0.06)
    if chart.y_range is None and any(mark.name for mark in chart.marks):
        y = y[0], y[1] + _NAMES * (y[1] - y[0])
    return Axis(*x, chart.logarithmic, _ACROSS, 1.0 if chart.numbered else 0.0), _upward(y, chart)


def _upward(limits: tuple[float, float], chart: Chart) -> Axis:
    return Axis(*limits, chart.logarithmic, angles=chart.angles, directions=chart.directions)


def _x(item: Item) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.concatenate([item.start, item.stop]) if isinstance(item, Levels) else np.asarray(item.x)


def _y(item: Item) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if isinstance(item, Band):
        return np.concatenate([item.low, item.high])
    if isinstance(item, Intervals):
        return np.concatenate([item.y - item.half, item.y + item.half])
    return np.asarray(item.y)


def _range(
    parts: list[np.ndarray[tuple[int], np.dtype[np.float64]]], chart: Chart, *, margin: float
) -> tuple[float, float]:
    values = np.concatenate([part[np.isfinite(part)] for part in parts]) if parts else np.zeros(0)
    if chart.logarithmic:
        values = values[values > 0.0]
        if not values.size:
            return 1.0, 10.0
        low, high = float(values.min()), float(values.max())
        return low / 1.15, high * 1.15
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    spread = (high - low) or 0.1 * abs(high) or 1.0
    if high == low:
        return low - spread, high + spread
    return low - margin * spread, high + margin * spread
