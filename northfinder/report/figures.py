"""The same charts as pictures, by matplotlib: SVG and PNG."""

from __future__ import annotations

import io
import math
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from northfinder.report.axes import axes_of
from northfinder.report.charts import Band, Chart, Intervals, Item, Levels, Line, charts
from northfinder.report.content import (
    azimuth_figure,
    other_figures,
    standing,
)
from northfinder.report.gather import RecordReport
from northfinder.text import printable

COLOURS = {
    "one": "#1e5ba6", "two": "#96590a", "three": "#2a7348", "accent": "#b0341f", "faint": "#74808c",
    "model": "#857e6a",
}  # fmt: skip
INK, MUTED, _RULE, _SHADE = "#1b2026", "#59626d", "#dcd9d1", "#efede6"
#: Letters that a chart of usual width has room for beside its title.
_LINE = 95
_STYLE = {
    "svg.hashsalt": "northfinder",  # the same data give the same file
    "text.parse_math": False,  # a device's name is no formula
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}


def draw(axes: Axes, chart: Chart) -> None:
    """Draw a chart."""
    across, upward = axes_of(chart)
    if chart.logarithmic:
        axes.set(xscale="log", yscale="log")
    axes.set(xlim=(across.low, across.high), ylim=(upward.low, upward.high))
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label, title=chart.title)
    for setter, axis in ((axes.set_xticks, across), (axes.set_yticks, upward)):
        setter([value for value, _ in axis.ticks()], labels=[text for _, text in axis.ticks()])
        setter([], minor=True)
    axes.grid(visible=True, axis="y", color=_RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for mark in chart.marks:
        axes.axvspan(mark.start, mark.stop, color=_SHADE, linewidth=0, zorder=0)
        if mark.name:
            middle = (mark.start + mark.stop) / 2
            axes.text(middle, 0.97, mark.name, transform=axes.get_xaxis_transform(), ha="center", va="top",
                      fontsize=7.0, color=MUTED, clip_on=True)  # fmt: skip
    for item in chart.items:
        _draw_item(axes, item)
    n_labels = sum(bool(item.label) for item in chart.items)
    if n_labels:
        # On a line of its own where there is no room beside the title.
        crowded = sum(len(item.label) + 6 for item in chart.items if item.label) + len(chart.title) > _LINE
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=n_labels, borderaxespad=0.1, handlelength=1.2,
                    columnspacing=1.2)  # fmt: skip
        axes.set_title(chart.title, pad=20.0 if crowded else None)


def _draw_item(axes: Axes, item: Item) -> None:
    colour, label = COLOURS[item.role], item.label
    match item:
        case Line():
            axes.plot(item.x, item.y, color=colour, linewidth=0.6 if item.role == "faint" else 1.0, label=label)
        case Band():
            axes.fill_between(item.x, item.low, item.high, color=colour, alpha=0.4, linewidth=0, label=label)
        case Levels():
            axes.hlines(item.y, item.start, item.stop, color=colour, linewidth=2.2, label=label)
        case Intervals():
            axes.errorbar(item.x, item.y, yerr=item.half, fmt=".", color=colour, capsize=2, label=label)


def draw_rose(axes: PolarAxes, report: RecordReport) -> None:
    """Draw the azimuth with its 95 % interval on a compass rose."""
    result = report.result
    azimuth, half = math.radians(result["azimuth_deg"]), report.interval * math.radians(result["azimuth_sd_deg"])
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetagrids(range(0, 360, 45), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    axes.set_yticks([])
    axes.set_ylim(0.0, 1.0)
    axes.grid(color=_RULE, linewidth=0.6)
    axes.bar(azimuth, 1.0, width=2.0 * min(half, math.pi), color=COLOURS["accent"], alpha=0.28, linewidth=0)
    axes.annotate(
        "", xy=(azimuth, 1.0), xytext=(0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": COLOURS["accent"], "lw": 2}
    )
    for name, key, role in (("grid", "convergence_deg", "two"), ("magnetic", "declination_deg", "three")):
        if key in result.get(name, {}):
            angle = math.radians(result[name][key])
            filled = COLOURS[role] if role == "three" else "none"  # no colour is needed to tell them apart
            axes.plot(
                [angle], [1.06], marker="v", color=COLOURS[role], markerfacecolor=filled, markersize=5, clip_on=False
            )


def overview(report: RecordReport) -> Figure:
    """Return the answer beside the rates it rests on."""
    figure = Figure(figsize=(10.0, 4.3))
    every = {chart.name: chart for chart in charts(report)}
    if "rate" in every:
        draw(figure.add_axes((0.06, 0.13, 0.56, 0.74)), every["rate"])
    answer = azimuth_figure(report)
    if answer is None:
        figure.text(0.82, 0.6, standing(report)[1], ha="center", fontsize=17, weight="bold")
        reason = "\n".join(textwrap.wrap(printable(report.failure, max_length=300), 42))
        figure.text(0.82, 0.56, reason, ha="center", va="top", fontsize=8.5, color=MUTED)
        return figure
    draw_rose(cast("PolarAxes", figure.add_axes((0.71, 0.25, 0.22, 0.5), projection="polar")), report)
    figure.text(0.82, 0.94, f"{answer.value} ± {answer.interval}", ha="center", va="center", fontsize=17, weight="bold")
    figure.text(0.82, 0.875, "true azimuth, 95 % interval", ha="center", va="center", fontsize=8.5, color=MUTED)
    lines = [f"{each.name.lower()} {each.value} ± {each.interval}" for each in other_figures(report) if each.interval]
    figure.text(0.82, 0.15, "\n".join(lines), ha="center", va="top", fontsize=9.5)
    return figure


def part(report: RecordReport, name: str) -> Figure:
    """Return one chart by its name, ``compass`` or ``overview``. Raises KeyError if the record has no such chart."""
    if name == "overview":
        return overview(report)
    if name == "compass":
        if report.fix is None:
            raise KeyError(name)
        figure = Figure(figsize=(4.0, 4.0), layout="constrained")
        draw_rose(cast("PolarAxes", figure.add_subplot(projection="polar")), report)
        return figure
    chart = {each.name: each for each in charts(report)}[name]
    figure = Figure(figsize=(8.0, 1.4 + 2.2 * chart.height), layout="constrained")
    draw(figure.add_subplot(), chart)
    return figure


def picture(report: RecordReport, name: str, kind: str) -> bytes:
    """Return one part as the content of an SVG or PNG file. Raises KeyError as `part`."""
    with report_style():
        return _saved(part(report, name), kind)


def charts_picture(drawn: Sequence[Chart], kind: str) -> bytes:
    """Return charts one below the other as the content of an SVG, PNG or PDF file."""
    with report_style():
        figure = Figure(figsize=(8.0, sum(1.0 + 2.2 * chart.height for chart in drawn)), layout="constrained")
        for row, chart in enumerate(drawn, start=1):
            draw(figure.add_subplot(len(drawn), 1, row), chart)
        return _saved(figure, kind)


@contextmanager
def report_style() -> Iterator[None]:
    """Draw in the report's style; a letter of a device's name that the font lacks is no reason to complain."""
    with mpl.rc_context(cast("Any", _STYLE)), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


def _saved(figure: Figure, kind: str) -> bytes:
    file = io.BytesIO()
    undated = {"svg": "Date", "pdf": "CreationDate", "png": "Software"}[kind]
    figure.savefig(file, format=kind, dpi=160, metadata={undated: None})
    return file.getvalue()
