"""The report as one HTML page that needs nothing else: no network, no script, no other file."""

from __future__ import annotations

import math
from functools import cache
from importlib.metadata import version
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from northfinder.report.chart_html import Plot, plot
from northfinder.report.charts import AVERAGING_TIME, DwellPair, charts, dwell_pairs
from northfinder.report.compass import rose, strip
from northfinder.report.content import (
    azimuth_figure,
    budget_lines,
    event_rows,
    identity_rows,
    method_rows,
    moment,
    other_figures,
    standing,
    summary_rows,
    three_digits,
    verdicts,
)
from northfinder.report.gather import RecordReport
from northfinder.text import printable
from northfinder.units import DPH


def record_page(report: RecordReport) -> str:
    """Return the page of one record."""
    pairs = dwell_pairs(report)
    good, words = standing(report)
    budget, idle = budget_lines(report)
    events, n_more_events = event_rows(report)
    began = "" if report.started is None else f", {moment(report.started)[:16]} UTC"
    return render(
        "record.html",
        title=f"True north{began}",
        good=good,
        standing=words,
        failure=printable(report.failure, max_length=1000),
        azimuth=azimuth_figure(report),
        others=other_figures(report),
        rose=_rose(report),
        strip=_strip(report),
        truth="" if report.truth is None else f"{report.truth[0]:g}°",
        verdicts=verdicts(report),
        budget=budget,
        idle=idle,
        has_latitude=any(line.latitude_width for line in budget),
        summary=summary_rows(report),
        plots=_named(report),
        dwells=[_dwell(pair) for pair in pairs],
        raw_limit=_limit(pairs[0].raw.y_range) if pairs else "",
        averaged_limit=_limit(pairs[0].averaged.y_range) if pairs else "",
        window=f"{AVERAGING_TIME:g}",
        n_more=len(report.dwells) - len(pairs),
        method=method_rows(report),
        identity=identity_rows(report),
        events=events,
        n_more_events=n_more_events,
        record=printable(report.path.name),
        version=version("northfinder"),
    )


def render(template: str, **content: Any) -> str:  # noqa: ANN401  # a template takes anything
    """Return a page of the templates; every text in it is escaped, and a name that is missing is a mistake of ours."""
    return _environment().get_template(template).render(**content)


@cache
def _environment() -> Environment:
    loader = PackageLoader("northfinder.report", "templates")
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.globals["style"] = Markup(loader.get_source(made, "style.css")[0])  # noqa: S704  # our own file
    return made


def _rose(report: RecordReport) -> Markup:
    if report.fix is None:
        return Markup("")
    result = report.result
    half = report.interval * result["azimuth_sd_deg"]
    grid, magnetic = result.get("grid", {}), result.get("magnetic", {})
    return rose(
        result["azimuth_deg"], half, grid_deg=grid.get("convergence_deg"), magnetic_deg=magnetic.get("declination_deg")
    )


def _strip(report: RecordReport) -> Markup:
    if report.fix is None:
        return Markup("")
    half = report.interval * report.result["azimuth_sd_deg"]
    truth = None if report.truth is None else report.truth[0]
    return strip(report.result["azimuth_deg"], half, truth_deg=truth)


def _named(report: RecordReport) -> dict[str, Plot | None]:
    names = ("rate", "residuals", "allan", "stage", "tilt", "temperature")
    made: dict[str, Plot | None] = dict.fromkeys(names)
    return made | {chart.name: plot(chart) for chart in charts(report)}


def _limit(y_range: tuple[float, float] | None) -> str:
    return "" if y_range is None else f"{y_range[1]:.2g}" if y_range[1] < 100 else f"{y_range[1]:,.0f}"


def _dwell(pair: DwellPair) -> dict[str, Any]:
    span = pair.dwell.span
    azimuth, elevation = math.degrees(span.measured_azimuth), math.degrees(span.measured_elevation)
    return {
        "title": f"{pair.number} {printable(span.name, max_length=20)}",
        "mean": ", ".join(f"{each:z.3f}" for each in pair.mean).replace("-", "−"),
        "sd": ", ".join(map(three_digits, pair.dwell.raw_sd / DPH)),
        "position": f"at {azimuth:z.1f}°, {elevation:z.1f}°, {span.dwell:.0f} s".replace("-", "−"),
        "raw": plot(pair.raw),
        "averaged": plot(pair.averaged),
    }
