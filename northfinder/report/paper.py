"""The report on paper: pages of A4 by matplotlib, as many as it takes."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Sequence
from typing import cast

import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.projections.polar import PolarAxes
from matplotlib.textpath import text_to_path

from northfinder.report.charts import charts
from northfinder.report.content import (
    BudgetLine,
    azimuth_figure,
    budget_lines,
    event_rows,
    identity_rows,
    method_rows,
    moment,
    other_figures,
    standing,
    summary_rows,
    verdicts,
)
from northfinder.report.figures import COLOURS, INK, MUTED, draw, draw_rose, report_style
from northfinder.report.gather import RecordReport

_A4 = (8.27, 11.69)  # inches
#: Margins, as parts of the page's width and height.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.08, 0.92, 0.955, 0.05
#: Where the second column of a table begins.
_INDENT = 0.24
#: Sum of the heights of charts that fill a page.
_FULL_PAGE = 4.5


def record_pdf(report: RecordReport) -> bytes:
    """Return the report as PDF: the answer and what speaks for it; the charts; the instrument, and what happened."""
    file = io.BytesIO()
    with report_style(), PdfPages(file, metadata={"Title": _title(report), "CreationDate": None}) as pages:
        for figure in record_pages(report):
            pages.savefig(figure)
    return file.getvalue()


def record_pages(report: RecordReport) -> list[Figure]:
    """Return the pages of the report, to be drawn in `report_style`."""
    return [*_answer_pages(report), *_chart_pages(report), *_origin_pages(report)]


def _title(report: RecordReport) -> str:
    return "True north" if report.started is None else f"True north, {moment(report.started)[:16]} UTC"


class _Paper:
    """Text that flows down pages of A4; `y` is where the next line begins, as part of the page's height."""

    def __init__(self) -> None:
        self.pages = [Figure(figsize=_A4)]
        self.y = _TOP

    @property
    def page(self) -> Figure:
        """The page in hand."""
        return self.pages[-1]

    def need(self, height: float) -> None:
        """Begin another page unless so much room is left."""
        if self.y - height < _BOTTOM:
            self.pages.append(Figure(figsize=_A4))
            self.y = _TOP

    def heading(self, title: str) -> None:
        """Write a heading that stays with a few lines of what it heads."""
        self.need(0.06)
        self.page.text(_LEFT, self.y, title, fontsize=10.5, weight="bold", va="top")
        self.y -= 0.02

    def text(self, text: str, *, x: float = _LEFT, size: float = 8.0, colour: str = MUTED) -> None:
        """Write wrapped text from `x` to the right margin."""
        lines = _wrapped(text, (_RIGHT - x) * _A4[0] * 72.0, size)
        height = len(lines) * size * 1.3 / 72.0 / _A4[1]
        self.need(height)
        self.page.text(x, self.y, "\n".join(lines), fontsize=size, color=colour, va="top", linespacing=1.25)
        self.y -= height

    def row(self, name: str, value: str, *, x: float = _INDENT, colour: str = MUTED, weight: str = "normal") -> None:
        """Write a name, and beside it from `x` what belongs to it."""
        pages, top = len(self.pages), self.y
        self.text(value, x=x, colour=INK)
        top = top if len(self.pages) == pages else _TOP
        self.page.text(_LEFT, top, name, fontsize=8, color=colour, weight=weight, va="top")
        self.y -= 0.001

    def rows(self, title: str, rows: Sequence[tuple[str, str]]) -> None:
        """Write a table of two columns under a heading, nothing if it is empty."""
        if rows:
            self.heading(title)
            for name, value in rows:
                self.row(name, value)
            self.y -= 0.012


def _wrapped(text: str, room: float, size: float) -> list[str]:
    """Return the lines of a text that are at most `room` points wide, by the letters' own widths."""
    n_letters = round(room / (0.45 * size))
    lines = textwrap.wrap(text, n_letters) or [""]
    while n_letters > 1 and (widest := max(_width(line, size) for line in lines)) > room:
        n_letters = max(1, min(n_letters - 1, math.floor(n_letters * room / widest)))
        lines = textwrap.wrap(text, n_letters)
    return lines


def _width(line: str, size: float) -> float:
    width, _, _ = text_to_path.get_text_width_height_descent(line, FontProperties(size=size), ismath=False)
    return float(width)


def _answer_pages(report: RecordReport) -> list[Figure]:
    paper = _Paper()
    paper.page.text(_LEFT, paper.y, _title(report), fontsize=15, weight="bold")
    paper.page.text(_LEFT, paper.y - 0.018, report.path.name[:90], color=MUTED)
    good, words = standing(report)
    colour = COLOURS["three" if good else "accent"]
    paper.page.text(_RIGHT, paper.y, "\n".join(textwrap.wrap(words, 40)), ha="right", weight="bold", color=colour)
    paper.y = 0.90
    _answer(paper, report)
    _checks(paper, report)
    _budget(paper, report)
    paper.rows("Measurement", summary_rows(report))
    paper.rows("How it was computed", method_rows(report))
    return paper.pages


def _answer(paper: _Paper, report: RecordReport) -> None:
    answer = azimuth_figure(report)
    if answer is None:
        paper.text(report.failure, size=11.0, colour=INK)
        paper.y -= 0.02
        return
    page, x = paper.page, 0.46
    draw_rose(cast("PolarAxes", page.add_axes((_LEFT, 0.67, 0.32, 0.226), projection="polar")), report)
    page.text(x, 0.872, answer.name.lower(), color=MUTED)
    page.text(x, 0.828, answer.value, fontsize=38, weight="bold")
    page.text(x, 0.802, f"± {answer.interval}", fontsize=17, color=COLOURS["accent"], weight="bold")
    paper.y = 0.79
    paper.text(answer.detail, x=x)
    for each in other_figures(report):
        interval = f" ± {each.interval}" if each.interval else ""
        paper.y -= 0.005
        page.text(x, paper.y, f"{each.name}  {each.value}{interval}", weight="bold", va="top")
        paper.y -= 0.016
        paper.text(each.detail, x=x)
    paper.y = min(0.63, paper.y - 0.02)


def _checks(paper: _Paper, report: RecordReport) -> None:
    made = verdicts(report)
    if not made:
        return
    paper.heading("Checks")
    colours = {"passed": COLOURS["three"], "warning": COLOURS["two"], "failed": COLOURS["accent"]}
    for each in made:
        paper.row(each.verdict, each.sentence, x=0.16, colour=colours[each.verdict], weight="bold")
    paper.y -= 0.014


def _budget(paper: _Paper, report: RecordReport) -> None:
    lines, idle = budget_lines(report)
    if not lines:
        return
    height = 0.019 * len(lines)
    paper.need(0.04 + height)
    paper.heading("What the uncertainty is made of")
    paper.text("Standard uncertainty that each source brings: to the azimuth above, to the latitude below.", size=7.5)
    paper.y -= 0.003
    _bars(paper, lines, height)
    paper.y -= height + 0.004
    paper.text(" ".join(idle), size=7.5)
    paper.y -= 0.014


def _bars(paper: _Paper, lines: Sequence[BudgetLine], height: float) -> None:
    axes = paper.page.add_axes((0.43, paper.y - height, 0.41, height))
    rows = np.arange(len(lines))
    axes.barh(rows - 0.2, [line.azimuth_width for line in lines], 0.32, color=COLOURS["accent"])
    axes.barh(rows + 0.2, [line.latitude_width for line in lines], 0.32, color=COLOURS["one"])
    axes.set(xlim=(0, 100), ylim=(len(lines) - 0.5, -0.5))
    axes.axis("off")
    for row, line in enumerate(lines):
        y = paper.y - height * (row + 0.5) / len(lines)
        paper.page.text(_LEFT, y, f"{line.quantity}  {line.size}", fontsize=8, va="center")
        shares = f"{line.azimuth}\n{line.latitude}"
        paper.page.text(_RIGHT, y, shares, fontsize=6.5, va="center", ha="right", linespacing=1.1)


def _chart_pages(report: RecordReport) -> list[Figure]:
    drawn = charts(report)
    if not drawn:
        return []
    figure = Figure(figsize=_A4, layout=ConstrainedLayoutEngine(rect=(0.04, 0.03, 0.92, 0.94), hspace=0.06))
    # A few charts are no taller than many.
    spare = max(0.0, _FULL_PAGE - sum(chart.height for chart in drawn))
    ratios = [*(chart.height for chart in drawn), *([spare] if spare else [])]
    grid = figure.add_gridspec(len(ratios), 1, height_ratios=ratios)
    for row, chart in enumerate(drawn):
        draw(figure.add_subplot(grid[row]), chart)
    return [figure]


def _origin_pages(report: RecordReport) -> list[Figure]:
    paper = _Paper()
    paper.rows("Instrument and software", identity_rows(report))
    events, n_more = event_rows(report)
    paper.rows("Events and notes", [(time, f"{kind}: {detail}" if detail else kind) for time, kind, detail in events])
    if n_more:
        paper.text(f"{n_more} later ones are in the record.")
    return paper.pages
