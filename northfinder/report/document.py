"""A report as data for programs, and as Markdown for notebooks and letters."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import msgspec

from northfinder.report.charts import pooled_allan
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
from northfinder.report.gather import Dwell, RecordReport
from northfinder.text import printable
from northfinder.units import DPH

#: What would be markup, or could begin some.
_MARKUP = re.compile(r"([\\`*_{}\[\]<>()#+!|~&$])")


def record_json(report: RecordReport) -> dict[str, Any]:
    """Return the report as plain data: the result as `solve` gives it, and what belongs to it; deg, deg/h and s."""
    good, words = standing(report)
    return {
        "result": report.result,
        "failure": report.failure,
        "standing": {"good": good, "sentence": words},
        "coverage_factor": None if math.isnan(report.interval) else report.interval,
        "started": None if report.started is None else moment(report.started),
        "ended": None if report.ended is None else moment(report.ended),
        "identities": msgspec.to_builtins(report.identities),
        **{name: report.meta.get(name) for name in ("northfinder", "plan", "config", "simulation", "sample_rate")},
        "n_missing": report.n_missing,
        "n_unfit": report.n_unfit,
        "dwells": [_dwell_json(dwell) for dwell in report.dwells],
        "residual_allan": _allan_json(report),
        "events": [{"time": time, "kind": kind, "detail": detail} for time, kind, detail in report.events],
    }


def _dwell_json(dwell: Dwell) -> dict[str, Any]:
    span = dwell.span
    return {
        "name": span.name,
        "azimuth_deg": math.degrees(span.measured_azimuth),
        "elevation_deg": math.degrees(span.measured_elevation),
        "start_s": dwell.start,
        "stop_s": dwell.stop,
        "n_samples": dwell.n_samples,
        "rate_dph": (dwell.mean / DPH).tolist(),
        "sample_sd_dph": (dwell.raw_sd / DPH).tolist(),
    }


def _allan_json(report: RecordReport) -> dict[str, Any] | None:
    if report.fix is None or report.used is None:
        return None
    pooled = pooled_allan(report.used.with_rate(report.fix.residuals), report.noise)
    if pooled is None:
        return None
    band = {} if report.noise is None else {"low_dph": pooled.low.tolist(), "high_dph": pooled.high.tolist()}
    return {"tau_s": pooled.tau.tolist(), "deviation_dph": pooled.deviation.T.tolist()} | band


def record_markdown(report: RecordReport) -> str:
    """Return the report's figures and tables as Markdown; whatever comes from a device or a file is escaped."""
    words = standing(report)[1]
    began = "" if report.started is None else f", {moment(report.started)[:16]} UTC"
    parts = [f"# True north{began}", f"**{escaped(words)}**", escaped(report.failure)]
    figure = azimuth_figure(report)
    if figure is not None:
        figures = [figure, *other_figures(report)]
        rows = [(each.name, _with_interval(each.value, each.interval), each.detail) for each in figures]
        parts.append(table(("", "± is the 95 % interval", ""), rows))
    checks = [(each.verdict, each.sentence) for each in verdicts(report)]
    parts += ["## Checks", table(("", ""), checks)] if checks else []
    lines, idle = budget_lines(report)
    if lines:
        shares = [(line.quantity, line.size, line.azimuth, line.latitude) for line in lines]
        head = ("standard uncertainty", "", "in azimuth", "in latitude")
        parts += ["## What the uncertainty is made of", table(head, shares)]
        parts += [escaped(" ".join(idle))]
    parts += ["## Measurement", table(("", ""), summary_rows(report)), _dwell_table(report)]
    parts += ["## How it was computed", table(("", ""), method_rows(report))] if method_rows(report) else []
    parts += ["## Instrument and software", table(("", ""), identity_rows(report))]
    events, _ = event_rows(report)
    parts += ["## Events and notes", table(("time, UTC", "what", ""), events)] if events else []
    return "\n\n".join(part for part in parts if part) + "\n"


def _with_interval(value: str, interval: str) -> str:
    return f"{value} ± {interval}" if interval else value


def _dwell_table(report: RecordReport) -> str:
    head = (
        "dwell",
        "position",
        "stage azimuth, deg",
        "elevation, deg",
        "time, s",
        "mean rate, deg/h",
        "sd of samples, deg/h",
    )
    rows = []
    for number, dwell in enumerate(report.dwells, start=1):
        span = dwell.span
        angles = (f"{math.degrees(angle):.4f}" for angle in (span.measured_azimuth, span.measured_elevation))
        mean = ", ".join(f"{each / DPH:z.3f}" for each in dwell.mean)
        sd = ", ".join(map(three_digits, dwell.raw_sd / DPH))
        seconds = f"{(span.stop_index - span.first_index) / span.sample_rate:.1f}"
        rows.append((str(number), printable(span.name), *angles, seconds, mean, sd))
    return table(head, rows) if rows else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; its cells are escaped, its head is ours."""
    lines = [head, ["---" for _ in head], *([escaped(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def escaped(text: str) -> str:
    r"""Return `text` so that Markdown shows it as it is.

    >>> print(escaped("<b>|x|"))
    \<b\>\|x\|
    """
    return _MARKUP.sub(r"\\\1", printable(text, max_length=1000))
