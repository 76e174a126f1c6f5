"""The report of a campaign: many records of one instrument, compared."""

from __future__ import annotations

import math
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from northfinder.angles import direction_text
from northfinder.estimation.quantiles import student_t
from northfinder.report.chart_html import plot
from northfinder.report.charts import Chart, Intervals, Item, Line, Mark
from northfinder.report.content import direction_with_interval, with_interval
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
        directions=name == "azimuth", marks=_turn_ons(result), x_range=(0.5, len(value) + 0.5), numbered=True,
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
    means = (direction_text(azimuth[part]["mean_deg"], 3) for part in parts)
    scattered = (_scattered(mean, azimuth[part]["sd_deg"]) for mean, part in zip(means, parts, strict=True))
    rows.append(["azimuth, deg", *scattered])
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
            f"{each['chi2']:.1f} with {each['dof']} degrees of freedom",
            f"{each['probability']:.2g}",
        ]
        for name, judged in result["consistency"].items()
        for key, each in judged.items()
    ]


def _record_table(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of what each record states; no latitudes if none was measured."""
    rows = [_record_row(number, row) for number, row in enumerate(result["records"], start=1)]
    kept = [name for name in rows[0] if any(row[name] for row in rows)]
    return kept, [[row[name] for name in kept] for row in rows]


def _record_row(number: int, row: dict[str, Any]) -> dict[str, str]:
    latitude, wide = row.get("latitude_stated_deg"), row["latitude_sd_deg"]
    return {
        "no.": str(number),
        "started, UTC": row["started"][:16].replace("T", " "),
        "turn-on": str(row["turn_on"]),
        "azimuth": " ± ".join(direction_with_interval(row["azimuth_deg"], _HALF * row["azimuth_sd_deg"])),
        "latitude": "" if latitude is None or not wide else " ± ".join(with_interval(latitude, _HALF * wide)),
        "verdict": "trustworthy" if row["trustworthy"] else "not trustworthy",
        "record": printable(Path(row["record"]).name),
    }


def _facts(result: dict[str, Any]) -> list[tuple[str, str]]:
    azimuth = result["azimuth"]
    within, between = azimuth["within_turn_on_sd_deg"], azimuth["between_turn_ons_sd_deg"]
    rows = [
        (
            "measurements",
            f"{result['n_records']}, after {result['n_turn_ons']} turn-on{'s'[: result['n_turn_ons'] > 1]}",
        )
    ]
    scatter = azimuth["all"]["sd_deg"]
    rows += [] if scatter is None else [("sd of one measurement", f"{scatter:.3f}°")]
    rows += [] if within is None else [("sd within a turn-on", f"{within:.3f}°")]
    rows += [] if between is None else [("sd between turn-ons", f"{between:.3f}°")]
    rows += [] if result["pause_h"] is None else [("pause", f"{result['pause_h']:.3g} h")]
    serials = sorted({printable(row["serial_number"]) for row in result["records"] if row["serial_number"]})
    rows += [("gyro", ", ".join(serials))] if serials else []
    return rows


_SCATTER_HEAD = "mean ± sd of one measurement"
_JUDGED_HEAD = ["scatter", "ratio to what was stated", "honest: 95 % within", "chi square", "probability"]
_PARTS = {"all": "all", "before": "before the pause", "after": "after the pause"}
#: Turn-ons are taken to differ if chance alone would make them seem to less often than this.
_UNLIKELY = 0.05


def of_the_mean(result: dict[str, Any]) -> tuple[float, str]:
    """Return half the 95 % interval of the mean azimuth, deg, and whose scatter it rests on, by Student's t.

    Measurements after the same turn-on share what that turn-on brought: where turn-ons differ, they are what counts.
    """
    rows, centre = result["records"], result["azimuth"]["all"]["mean_deg"]
    off = np.array([math.remainder(row["azimuth_deg"] - centre, 360.0) for row in rows])
    probability = result["azimuth"]["between_turn_ons_probability"]
    words = f"{len(rows)} measurements"
    if probability is not None and probability < _UNLIKELY:
        _, group, counts = np.unique([row["turn_on"] for row in rows], return_inverse=True, return_counts=True)
        off = np.bincount(group, off) / counts
        words = f"{len(off)} turn-ons, which differ"
    return student_t(0.025, len(off) - 1) * float(np.std(off, ddof=1)) / math.sqrt(len(off)), words


def campaign_page(result: dict[str, Any]) -> str:
    """Return the page of `campaign_report.campaign_json`."""
    half, words = of_the_mean(result)
    value, interval = direction_with_interval(result["azimuth"]["all"]["mean_deg"], half)
    head, rows = _record_table(result)
    return render(
        "campaign.html",
        title=f"Campaign of {result['n_records']} measurements",
        value=value,
        interval=interval,
        basis=words,
        facts=_facts(result),
        plots=[plot(chart) for chart in campaign_charts(result)],
        scatter_head=_scatter_head(result),
        scatter_rows=_scatter_rows(result),
        judged_head=_JUDGED_HEAD,
        judged_rows=_judged_rows(result),
        record_head=head,
        record_rows=rows,
        version=version("northfinder"),
    )


def campaign_markdown(result: dict[str, Any]) -> str:
    """Return the tables of `campaign_report.campaign_json` as Markdown."""
    half, words = of_the_mean(result)
    mean = " ± ".join(direction_with_interval(result["azimuth"]["all"]["mean_deg"], half))
    parts = [f"# Campaign of {result['n_records']} measurements"]
    parts += [f"Mean azimuth **{mean}**, 95 % interval by the scatter of {words}.", table(("", ""), _facts(result))]
    parts += ["## Scatter", table(_scatter_head(result), _scatter_rows(result))]
    parts += [table(_JUDGED_HEAD, _judged_rows(result)), "## Records", table(*_record_table(result))]
    return "\n\n".join(parts) + "\n"


def _scatter_head(result: dict[str, Any]) -> list[str]:
    return [_SCATTER_HEAD, *(_PARTS[part] for part in _parts(result))]


def _pair(mean: float | None, sd: float | None) -> str:
    return "" if mean is None else _scattered(f"{mean:z.3f}", sd)


def _scattered(mean: str, sd: float | None) -> str:
    return mean if sd is None else f"{mean} ± {sd:.3f}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
