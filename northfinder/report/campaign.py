"""The report of a campaign: many records of one instrument, compared."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from northfinder.estimation.quantiles import student_t
from northfinder.report.chart_html import plot
from northfinder.report.charts import Chart, Intervals, Item, Line, Mark
from northfinder.report.content import with_interval
from northfinder.report.document import table
from northfinder.report.page import render
from northfinder.text import printable

#: Half of a 95 % interval in standard deviations of a stated fix.
_HALF = student_t(0.025, float("inf"))
_JUDGED = {"all": "all together", "within_turn_ons": "within turn-ons", "against_truth": "against the truth"}
_ROWS = {
    "bias_horizontal_dph": "bias, horizontal plane, deg/h",
    "bias_vertical_dph": "bias, vertical plane, deg/h",
    "scale_factor_horizontal": "scale factor, horizontal plane",
    "scale_factor_vertical": "scale factor, vertical plane",
    "ratio": "ratio k of the scale factors",
    "stated": "latitude as stated, deg",
    "plain": "latitude, nothing corrected, deg",
    "with_ratio": "latitude with k, deg",
}


def campaign_charts(result: dict[str, Any]) -> list[Chart]:
    """Return azimuth and latitude of each measurement, as `campaign_report.campaign_json` gives them."""
    rows = result["records"]
    centre = result["azimuth"]["all"]["mean_deg"]
    azimuth = np.array([(row["azimuth_deg"] - centre + 180.0) % 360.0 - 180.0 + centre for row in rows])
    sd = np.array([row["azimuth_sd_deg"] for row in rows])
    made = [_chart("azimuth", "Azimuth of each measurement", azimuth, sd, result, result["true_azimuth_deg"])]
    if "stated" in result["latitude"]:
        latitude = np.array([row.get("latitude_stated_deg", np.nan) for row in rows])
        latitude_sd = np.array([row["latitude_sd_deg"] or np.nan for row in rows])
        title = "Latitude of each measurement"
        made.append(_chart("latitude", title, latitude, latitude_sd, result, result["true_latitude_deg"]))
    return made


def _chart(
    name: str,
    title: str,
    value: np.ndarray[tuple[int], np.dtype[np.float64]],
    sd: np.ndarray[tuple[int], np.dtype[np.float64]],
    result: dict[str, Any],
    truth: float | None,
) -> Chart:
    number = np.arange(1.0, len(value) + 1.0)
    items: list[Item] = [Intervals(x=number, y=value, half=_HALF * sd, role="accent", label="with its 95 % interval")]
    ends = np.array([0.5, len(value) + 0.5])
    if truth is not None:
        items.append(Line(x=ends, y=np.full(2, truth), role="one", label="truth"))
    items.append(Line(x=ends, y=np.full(2, np.nanmean(value)), role="model", label="mean"))
    return Chart(
        name=name, title=title, x_label="measurement", y_label="deg", items=tuple(items),
        marks=_turn_ons(result), x_range=(0.5, len(value) + 0.5), numbered=True,
        note="Every second turn-on is shaded." if result["n_turn_ons"] > 1 else "",
    )  # fmt: skip


def _turn_ons(result: dict[str, Any]) -> tuple[Mark, ...]:
    """Return every second turn-on as a mark."""
    turn_on = [row["turn_on"] for row in result["records"]]
    marks = []
    for each in sorted(set(turn_on))[1::2]:
        members = [i for i, own in enumerate(turn_on, start=1) if own == each]
        marks.append(Mark(start=members[0] - 0.5, stop=members[-1] + 0.5))
    return tuple(marks)


def _parts(result: dict[str, Any]) -> list[str]:
    return [name for name in ("all", "before", "after") if name in result["azimuth"]]


def _scatter_rows(result: dict[str, Any]) -> list[list[str]]:
    parts, azimuth = _parts(result), result["azimuth"]
    rows = [["n", *(str(azimuth[part]["n"]) for part in parts)]]
    rows.append(["azimuth, deg", *(_pair(azimuth[part]["mean_deg"], azimuth[part]["sd_deg"]) for part in parts)])
    if result["true_latitude_deg"] is not None:
        levels = (azimuth[part]["sd_cos_latitude_deg"] for part in parts)
        rows.append(["sd · cos(latitude), deg", *(_number(level) for level in levels)])
    for name, title in _ROWS.items():
        values = result["planes"].get(name) or result["latitude"].get(name)
        if values is not None:
            lines = [values[part] for part in parts]
            pairs = (_pair(x.get("mean", x.get("mean_deg")), x.get("sd", x.get("sd_deg"))) for x in lines)
            rows.append([title, *pairs])
    return rows


def _judged_rows(result: dict[str, Any]) -> list[list[str]]:
    return [
        [
            f"{name}, {_JUDGED[key]}",
            f"{each['rms']:.2f}",
            f"{each['low']:.2f} to {each['high']:.2f}",
            f"{each['chi2']:.1f} of {each['dof']}",
            f"{each['probability']:.2g}",
        ]
        for name, judged in result["consistency"].items()
        for key, each in judged.items()
    ]


def _record_rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for number, row in enumerate(result["records"], start=1):
        azimuth = " ± ".join(with_interval(row["azimuth_deg"], _HALF * row["azimuth_sd_deg"]))
        latitude = row.get("latitude_stated_deg")
        wide = row["latitude_sd_deg"]
        shown = "" if latitude is None or not wide else " ± ".join(with_interval(latitude, _HALF * wide))
        verdict = "trustworthy" if row["trustworthy"] else "not trustworthy"
        name = printable(Path(row["record"]).name)
        rows.append(
            [str(number), row["started"][:16].replace("T", " "), str(row["turn_on"]), azimuth, shown, verdict, name]
        )
    return rows


def _facts(result: dict[str, Any]) -> list[tuple[str, str]]:
    azimuth = result["azimuth"]
    within, between = azimuth["within_turn_on_sd_deg"], azimuth["between_turn_ons_sd_deg"]
    rows = [
        (
            "measurements",
            f"{result['n_records']}, after {result['n_turn_ons']} turn-on{'s'[: result['n_turn_ons'] > 1]}",
        )
    ]
    rows += [] if within is None else [("sd within a turn-on", f"{within:.3f}°")]
    rows += [] if between is None else [("sd between turn-ons", f"{between:.3f}°")]
    rows += [] if result["pause_h"] is None else [("pause", f"{result['pause_h']:.3g} h")]
    serials = sorted({printable(row["serial_number"]) for row in result["records"] if row["serial_number"]})
    rows += [("gyro", ", ".join(serials))] if serials else []
    return rows


_SCATTER_HEAD = "mean ± sd of one measurement"
_JUDGED_HEAD = ["scatter over what was stated", "ratio", "95 % of honest ones", "chi square", "probability"]
_RECORD_HEAD = ["", "started, UTC", "turn-on", "azimuth", "latitude", "", "record"]


def campaign_page(result: dict[str, Any]) -> str:
    """Return the page of `campaign_report.campaign_json`."""
    mean, sd = result["azimuth"]["all"]["mean_deg"], result["azimuth"]["all"]["sd_deg"] or 0.0
    value, scatter = with_interval(mean, sd)
    return render(
        "campaign.html",
        title=f"Campaign of {result['n_records']} measurements",
        value=value,
        scatter=scatter,
        facts=_facts(result),
        plots=[plot(chart) for chart in campaign_charts(result)],
        scatter_head=[_SCATTER_HEAD, *_parts(result)],
        scatter_rows=_scatter_rows(result),
        judged_head=_JUDGED_HEAD,
        judged_rows=_judged_rows(result),
        record_head=_RECORD_HEAD,
        record_rows=_record_rows(result),
        version=version("northfinder"),
    )


def campaign_markdown(result: dict[str, Any]) -> str:
    """Return the tables of `campaign_report.campaign_json` as Markdown."""
    parts = [f"# Campaign of {result['n_records']} measurements", table(("", ""), _facts(result))]
    parts += ["## Scatter", table([_SCATTER_HEAD, *_parts(result)], _scatter_rows(result))]
    parts += [table(_JUDGED_HEAD, _judged_rows(result)), "## Records", table(_RECORD_HEAD, _record_rows(result))]
    return "\n\n".join(parts) + "\n"


def _pair(mean: float | None, sd: float | None) -> str:
    return "" if mean is None else f"{mean:.3f} ± {_number(sd)}"


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.3f}"
