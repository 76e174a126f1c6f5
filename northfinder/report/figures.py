"""The same charts as pictures and on paper, by matplotlib: SVG, PNG, and two pages of A4 as PDF."""

from __future__ import annotations

import io
import math
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.projections.polar import PolarAxes

from northfinder.report.axes import axes_of
from northfinder.report.charts import Band, Chart, Intervals, Item, Levels, Line, charts
from northfinder.report.content import (
    azimuth_figure,
    budget_lines,
    identity_rows,
    method_rows,
    moment,
    other_figures,
    standing,
    summary_rows,
    verdicts,
)
from northfinder.report.gather import RecordReport

_COLOURS = {
    "one": "#1e5ba6", "two": "#96590a", "three": "#2a7348", "accent": "#b0341f", "faint": "#98a1ab",
    "model": "#b9b4a6",
}  # fmt: skip
_INK, _MUTED, _RULE, _SHADE = "#1b2026", "#59626d", "#dcd9d1", "#efede6"
_A4 = (8.27, 11.69)  # inches
_STYLE = {
    "svg.hashsalt": "northfinder",  # the same data give the same file
    "text.parse_math": False,  # a device's name is no formula
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": _MUTED,
    "axes.labelcolor": _MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": _MUTED,
    "ytick.color": _MUTED,
    "text.color": _INK,
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
                      fontsize=7.0, color=_MUTED, clip_on=True)  # fmt: skip
    for item in chart.items:
        _draw_item(axes, item)
    if any(item.label for item in chart.items):
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1, handlelength=1.2)


def _draw_item(axes: Axes, item: Item) -> None:
    colour, label = _COLOURS[item.role], item.label
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
    axes.bar(azimuth, 1.0, width=2.0 * min(half, math.pi), color=_COLOURS["accent"], alpha=0.28, linewidth=0)
    axes.annotate(
        "", xy=(azimuth, 1.0), xytext=(0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": _COLOURS["accent"], "lw": 2}
    )
    for name, key, role in (("grid", "convergence_deg", "two"), ("magnetic", "declination_deg", "three")):
        if key in result.get(name, {}):
            angle = math.radians(result[name][key])
            axes.plot([angle], [1.06], marker="v", color=_COLOURS[role], markersize=4, clip_on=False)


def overview(report: RecordReport) -> Figure:
    """Return the answer beside the rates it rests on."""
    figure = Figure(figsize=(10.0, 4.3))
    every = {chart.name: chart for chart in charts(report)}
    if "rate" in every:
        draw(figure.add_axes((0.06, 0.13, 0.56, 0.74)), every["rate"])
    answer = azimuth_figure(report)
    if answer is None:
        figure.text(0.99, 0.95, standing(report)[1], ha="right")
        return figure
    draw_rose(cast("PolarAxes", figure.add_axes((0.71, 0.25, 0.22, 0.5), projection="polar")), report)
    figure.text(0.82, 0.94, f"{answer.value} ± {answer.interval}", ha="center", va="center", fontsize=17, weight="bold")
    figure.text(0.82, 0.875, "true azimuth, 95 % interval", ha="center", va="center", fontsize=8.5, color=_MUTED)
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
    with _style():
        return _saved(part(report, name), kind)


def charts_picture(drawn: Sequence[Chart], kind: str) -> bytes:
    """Return charts one below the other as the content of an SVG, PNG or PDF file."""
    with _style():
        figure = Figure(figsize=(8.0, sum(1.0 + 2.2 * chart.height for chart in drawn)), layout="constrained")
        for row, chart in enumerate(drawn, start=1):
            draw(figure.add_subplot(len(drawn), 1, row), chart)
        return _saved(figure, kind)


@contextmanager
def _style() -> Iterator[None]:
    """Draw in the report's style; a letter of a device's name that the font lacks is no reason to complain."""
    with mpl.rc_context(cast("Any", _STYLE)), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


def _saved(figure: Figure, kind: str) -> bytes:
    file = io.BytesIO()
    undated = {"svg": "Date", "pdf": "CreationDate", "png": "Software"}[kind]
    figure.savefig(file, format=kind, dpi=160, metadata={undated: None})
    return file.getvalue()


def record_pdf(report: RecordReport) -> bytes:
    """Return the report on two pages of A4: the answer and what speaks for it, then the charts."""
    file = io.BytesIO()
    with _style(), PdfPages(file, metadata={"Title": "True north", "CreationDate": None}) as pages:
        pages.savefig(_first_page(report))
        if charts(report):
            pages.savefig(_second_page(report))
    return file.getvalue()


def _first_page(report: RecordReport) -> Figure:
    figure = Figure(figsize=_A4)
    began = "" if report.started is None else f"{moment(report.started)} UTC"
    figure.text(0.08, 0.955, "True north", fontsize=15, weight="bold")
    figure.text(0.08, 0.937, f"{began}   {report.path.name}", color=_MUTED)
    figure.text(0.92, 0.955, standing(report)[1][:60], ha="right", weight="bold")
    top = 0.90
    answer = azimuth_figure(report)
    if answer is not None:
        rose = cast("PolarAxes", figure.add_axes((0.08, 0.67, 0.32, 0.226), projection="polar"))
        draw_rose(rose, report)
        figure.text(0.46, 0.845, answer.value, fontsize=38, weight="bold")
        figure.text(0.46, 0.815, f"± {answer.interval}", fontsize=17, color=_COLOURS["accent"], weight="bold")
        y = _text(figure, 0.46, 0.803, answer.detail, width=68, size=8)
        for each in other_figures(report):
            interval = f" ± {each.interval}" if each.interval else ""
            figure.text(0.46, y - 0.014, f"{each.name}  {each.value}{interval}", weight="bold")
            y = _text(figure, 0.46, y - 0.017, each.detail, width=68, size=8)
        top = 0.63
    top = _checks(figure, report, top)
    top = _bars(figure, report, top)
    for title, rows in (("Measurement", summary_rows(report)), ("How it was computed", method_rows(report)),
                        ("Instrument and software", identity_rows(report))):  # fmt: skip
        top = _rows(figure, title, rows, top)
    return figure


def _text(figure: Figure, x: float, y: float, text: str, *, width: int, size: float, colour: str = _MUTED) -> float:
    """Write wrapped text below `y`, and return where it ends."""
    lines = textwrap.wrap(text, width) or [""]
    figure.text(x, y, "\n".join(lines), fontsize=size, color=colour, va="top", linespacing=1.25)
    return y - len(lines) * size * 1.3 / 72.0 / _A4[1]


def _heading(figure: Figure, title: str, y: float) -> float:
    figure.text(0.08, y, title, fontsize=10.5, weight="bold", va="top")
    return y - 0.02


def _checks(figure: Figure, report: RecordReport, y: float) -> float:
    made = verdicts(report)
    if not made:
        return y
    y = _heading(figure, "Checks", y)
    colours = {"passed": _COLOURS["three"], "warning": _COLOURS["two"], "failed": _COLOURS["accent"]}
    for each in made:
        figure.text(0.08, y, each.verdict, fontsize=8, weight="bold", color=colours[each.verdict], va="top")
        y = _text(figure, 0.16, y, each.sentence, width=118, size=8, colour=_INK) - 0.001
    return y - 0.014


def _bars(figure: Figure, report: RecordReport, y: float) -> float:
    lines, exact = budget_lines(report)
    if not lines:
        return y
    y = _heading(figure, "What the uncertainty is made of: azimuth above, latitude below", y)
    height = 0.019 * len(lines)
    axes = figure.add_axes((0.43, y - height, 0.41, height))
    rows = np.arange(len(lines))
    axes.barh(rows - 0.2, [line.azimuth_width for line in lines], 0.32, color=_COLOURS["accent"])
    axes.barh(rows + 0.2, [line.latitude_width for line in lines], 0.32, color=_COLOURS["one"])
    axes.set(xlim=(0, 100), ylim=(len(lines) - 0.5, -0.5))
    axes.axis("off")
    for row, line in enumerate(lines):
        at = y - height * (row + 0.5) / len(lines)
        figure.text(0.08, at, f"{line.quantity}  {line.size}", fontsize=8, va="center")
        figure.text(
            0.92, at, f"{line.azimuth}\n{line.latitude}", fontsize=6.5, va="center", ha="right", linespacing=1.1
        )
    y -= height + 0.004
    return (_text(figure, 0.08, y, f"Taken as exact: {exact}.", width=125, size=7.5) if exact else y) - 0.014


def _rows(figure: Figure, title: str, rows: Sequence[tuple[str, str]], y: float) -> float:
    if not rows:
        return y
    y = _heading(figure, title, y)
    for name, value in rows:
        figure.text(0.08, y, name, fontsize=8, color=_MUTED, va="top")
        y = _text(figure, 0.24, y, value, width=104, size=8, colour=_INK) - 0.001
    return y - 0.012


def _second_page(report: RecordReport) -> Figure:
    drawn = charts(report)
    figure = Figure(figsize=_A4, layout=ConstrainedLayoutEngine(rect=(0.04, 0.03, 0.92, 0.94), hspace=0.06))
    grid = figure.add_gridspec(len(drawn), 1, height_ratios=[chart.height for chart in drawn])
    for row, chart in enumerate(drawn):
        draw(figure.add_subplot(grid[row]), chart)
    return figure
