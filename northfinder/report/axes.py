"""Where the ticks of an axis stand, and what they say."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from northfinder.report.charts import Band, Chart, Intervals, Item, Levels

#: Stretches between the ticks of an axis, at most.
_ACROSS, _UPWARD = 9, 6
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

    def place(self, value: float) -> float:
        """Return where `value` stands, 0 at the low end and 1 at the high one."""
        if self.logarithmic:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[tuple[float, str]]:
        """Return (value, text) of round values within the range."""
        return (
            _decades(self.low, self.high)
            if self.logarithmic
            else _rounds(self.low, self.high, self.most, self.least_step)
        )


def _rounds(low: float, high: float, most: int, least_step: float = 0.0) -> list[tuple[float, str]]:
    """Return multiples of 1, 2 or 5 times a power of ten.

    >>> [text for _, text in _rounds(0.0, 16.2, 6)]
    ['0', '5', '10', '15']
    """
    power = 10.0 ** math.floor(math.log10(max((high - low) / most, least_step)))
    step = next(power * m for m in (1, 2, 5, 10) if (high - low) / (power * m) <= most and power * m >= least_step)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(k * step, f"{k * step:.{decimals}f}".replace("-", "−")) for k in range(first, last + 1)]


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
    return Axis(*x, chart.logarithmic, _ACROSS, 1.0 if chart.numbered else 0.0), Axis(*y, chart.logarithmic)


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
