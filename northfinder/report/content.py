"""What a report says in words and figures, apart from how: the page, Markdown and pictures take it from here.

All intervals are 95 % intervals, so many standard deviations as the fix itself says.
"""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import dataclass
from typing import Any

from northfinder.angles import decimals_for, direction_text
from northfinder.estimation.quantiles import student_t
from northfinder.report.gather import RecordReport
from northfinder.text import printable

_NOTHING = 1e-9  # deg
#: Least part of the uncertainty that is told in figures, deg.
_LEAST_SHARE = 1e-4
#: Half of a 95 % interval in standard deviations that are known.
_HALF = student_t(0.025, math.inf)
#: A name or note longer than this is cut.
_MAX_TEXT = 500


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One angle of the answer."""

    name: str
    value: str  #: empty if there is none
    interval: str = ""  #: half of the 95 % interval
    detail: str = ""
    role: str = ""  #: colour of its mark on the compass rose


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """One check in words."""

    passed: bool
    verdict: str
    name: str
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetLine:
    """One contribution to the uncertainty; the widths are relative to the largest of all."""

    quantity: str
    size: str
    azimuth: str
    azimuth_width: float
    latitude: str
    latitude_width: float


def with_interval(value_deg: float, half_deg: float) -> tuple[str, str]:
    """Return an angle and half its interval as text, to two digits of the interval.

    >>> with_interval(32.96839, 0.20742)
    ('32.97°', '0.21°')
    """
    decimals = decimals_for(half_deg)
    return signed(value_deg, decimals), f"{half_deg:.{decimals}f}°"


def direction_with_interval(angle_deg: float, half_deg: float) -> tuple[str, str]:
    """Return the same of a direction, which ends below 360 deg.

    >>> direction_with_interval(359.999, 0.20742)
    ('0.00°', '0.21°')
    """
    decimals = decimals_for(half_deg)
    return f"{direction_text(angle_deg, decimals)}°", f"{half_deg:.{decimals}f}°"


def signed(value: float, decimals: int) -> str:
    """Return an angle in deg as text.

    >>> signed(-64.944, 2), signed(-0.0001, 2)
    ('−64.94°', '0.00°')
    """
    return f"{value:z.{decimals}f}°".replace("-", "−")


def three_digits(value: float) -> str:
    """Return a size to three digits, one of thousands in full.

    >>> three_digits(0.017654), three_digits(253.8), three_digits(2134.6)
    ('0.0177', '254', '2,135')
    """
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:,.0f}"  # never with a power of ten


def azimuth_figure(report: RecordReport) -> Figure | None:
    """Return the azimuth, None without a fix."""
    result = report.result
    if report.fix is None:
        return None
    half = report.interval * result["azimuth_sd_deg"]
    value, interval = direction_with_interval(result["azimuth_deg"], half)
    ends = (direction_with_interval(result["azimuth_deg"] + k * half, half)[0] for k in (-1.0, 1.0))
    detail = f"95 % interval {' to '.join(ends)}; of the input axis at stage azimuth zero, clockwise from true north"
    return Figure(name="True azimuth", value=value, interval=interval, detail=detail, role="accent")


def other_figures(report: RecordReport) -> list[Figure]:
    """Return latitude, grid azimuth and magnetic bearing, or why there are none."""
    return [] if report.fix is None else [_latitude(report), *_bearings(report)]


def _latitude(report: RecordReport) -> Figure:
    result = report.result
    latitude, sd = result["latitude_deg"], result["latitude_sd_deg"]
    if latitude is None:
        return Figure(name="Latitude", value="", detail=f"not measured: {result['latitude_reason']}")
    if not sd:
        return Figure(name="Latitude", value=signed(latitude, 3), detail="as given")
    value, interval = with_interval(latitude, report.interval * sd)
    return Figure(name="Latitude", value=value, interval=interval, detail=_latitude_source(report))


def _latitude_source(report: RecordReport) -> str:
    given = report.assumptions is not None and report.assumptions.latitude_deg is not None
    return "measured and given, put together" if given else "measured"


def _bearings(report: RecordReport) -> list[Figure]:
    if "position" not in report.result:
        detail = "no position given (--position LAT,LON)"
        return [Figure(name=name, value="", detail=detail) for name in ("Grid azimuth", "Magnetic bearing")]
    grid, magnetic = report.result["grid"], report.result["magnetic"]
    figures = [_missing("Grid azimuth", grid), _missing("Magnetic bearing", magnetic)]
    if "azimuth_deg" in grid:
        value, interval = direction_with_interval(grid["azimuth_deg"], report.interval * grid["azimuth_sd_deg"])
        detail = f"{printable(grid['name'])}, EPSG:{grid['epsg']}; convergence {signed(grid['convergence_deg'], 4)}"
        figures[0] = Figure(name="Grid azimuth", value=value, interval=interval, detail=detail, role="two")
    if "bearing_deg" in magnetic:
        value, interval = direction_with_interval(magnetic["bearing_deg"], report.interval * magnetic["bearing_sd_deg"])
        declination, wide = with_interval(magnetic["declination_deg"], report.interval * magnetic["declination_sd_deg"])
        detail = (
            f"declination {declination} ± {wide} on {magnetic['date']} by {printable(magnetic['model'])}, "
            f"which holds from {magnetic['valid_from']} to {magnetic['valid_until']}"
        )
        figures[1] = Figure(name="Magnetic bearing", value=value, interval=interval, detail=detail, role="three")
    return figures


def _missing(name: str, table: dict[str, Any]) -> Figure:
    return Figure(name=name, value="", detail=printable(table.get("reason", "")))


def standing(report: RecordReport) -> tuple[bool, str]:
    """Return whether the measurement may be relied on, and that in a few words."""
    if report.fix is None:
        return False, "No azimuth"
    if not report.result.get("complete", True):
        return False, f"Ends before the measurement did, after {report.result['steps']}"
    failed = [check for check in report.result["checks"] if not check["passed"]]
    if any(check["decisive"] for check in failed):
        return False, "Not trustworthy: a decisive check failed"
    return (
        True,
        "All checks passed" if not failed else f"Trustworthy, with {len(failed)} warning{'s'[: len(failed) > 1]}",
    )


def verdicts(report: RecordReport) -> list[Verdict]:
    """Return the checks, the failed ones first."""
    made = [
        Verdict(
            passed=check["passed"],
            verdict="passed" if check["passed"] else "failed" if check["decisive"] else "warning",
            name=printable(check["name"]),
            sentence=printable(check["sentence"], max_length=_MAX_TEXT),
        )
        for check in report.result.get("checks", [])
    ]
    return sorted(made, key=lambda each: each.passed)


def budget_lines(report: RecordReport) -> tuple[list[BudgetLine], list[str]]:
    """Return what the uncertainty is made of, the largest first, and in sentences what must be known of it."""
    lines = report.result.get("budget", [])
    largest = {line["quantity"]: max(line["azimuth_deg"], line["latitude_deg"]) for line in lines}
    widest = max(largest.values(), default=0.0)
    made = [
        BudgetLine(
            quantity=line["quantity"],
            size=f"{line['sd']:.3g} {line['unit']}".strip(),
            azimuth=_share(line["azimuth_deg"]),
            azimuth_width=100.0 * line["azimuth_deg"] / widest,
            latitude=_share(line["latitude_deg"]),
            latitude_width=100.0 * line["latitude_deg"] / widest,
        )
        for line in lines
        if largest[line["quantity"]] > _NOTHING
    ]
    idle = [line["quantity"] for line in lines if line["sd"] and largest[line["quantity"]] <= _NOTHING]
    exact = [line["quantity"] for line in lines if not line["sd"]]
    told = (("Without effect on this measurement", idle), ("Taken as exact", exact))
    said = [f"{what}: {', '.join(names)}." for what, names in told if names]
    if made and report.noise is not None and report.result["rescaled_by"] > 1.0:
        said.insert(0, f"The noise is {report.result['rescaled_by']:.2f} times the profile's, as the residuals ask.")
    return made, said


def _share(angle_deg: float) -> str:
    if angle_deg <= _NOTHING:
        return "none"
    return f"{angle_deg:.4f}°" if angle_deg >= _LEAST_SHARE else f"< {_LEAST_SHARE:.4f}°"


def identity_rows(report: RecordReport) -> list[tuple[str, str]]:
    """Return which instrument, software and data the report is of."""
    rows = []
    for kind, device in sorted(report.identities.items()):
        told = [device.model, f"serial number {device.serial_number}"]
        told += [f"firmware {device.firmware_version}"] if device.firmware_version else []
        told += [device.protocol] if device.protocol else []
        told += [f"turn-on {device.boot_count}"] if device.boot_count else []
        rows.append((kind, ", ".join(told)))
    rows += [(f"{kind} address", address) for kind, address in _addresses(report.meta.get("config"))]
    rate = report.meta.get("sample_rate")
    n_axes = (
        "" if report.means is None else f", {report.means.n_axes} input ax{'is' if report.means.n_axes == 1 else 'es'}"
    )
    rows += [("samples", f"{rate:g} a second{n_axes}")] if isinstance(rate, int | float) else []
    if report.truth is not None:
        azimuth, latitude = report.truth
        rows.append(("emulated bench", f"its truth is azimuth {azimuth:g}°, latitude {latitude:g}°"))
    rows.append(("software", f"northfinder {report.meta.get('northfinder') or 'of unknown version'}"))
    rows.append(("record", report.path.name))
    return [(printable(name), printable(value, max_length=_MAX_TEXT)) for name, value in rows]


def _addresses(config: object) -> list[tuple[str, str]]:
    if not isinstance(config, dict):
        return []
    tables = [(kind, config.get(kind)) for kind in ("gyro", "stage")]
    return [(kind, str(table["address"])) for kind, table in tables if isinstance(table, dict) and table.get("address")]


def summary_rows(report: RecordReport) -> list[tuple[str, str]]:
    """Return when and how it was measured."""
    rows = []
    if report.started is not None and report.ended is not None:
        rows.append(("measured", f"{moment(report.started)} UTC"))
    plan = report.meta.get("plan")
    name = str(plan.get("name")) if isinstance(plan, dict) else "unknown"
    rows.append(("plan", f"{name}, {report.result['steps']}"))
    if report.dwells:
        rows.append(("end of the last dwell", f"{report.dwells[-1].stop / 60:.1f} min after the first sample"))
    if report.n_streams > 1:
        often = "once" if report.n_streams == 2 else f"{report.n_streams - 1} times"
        rows.append(("resumed", f"{often}, after an interruption"))
    n_samples = sum(dwell.n_samples for dwell in report.dwells)
    lost = f", {report.n_missing:,} missing" if report.n_missing else ", none missing"
    unfit = f", {report.n_unfit:,} declared unfit by the gyro" if report.n_unfit else ""
    rows.append(("samples in dwells", f"{n_samples:,}{lost}{unfit}"))
    return [(name, printable(value)) for name, value in rows]


def method_rows(report: RecordReport) -> list[tuple[str, str]]:
    """Return how the fix was computed."""
    fix, assumptions, result = report.fix, report.assumptions, report.result
    if fix is None or assumptions is None:
        return []
    rows = [("estimate", _estimate_sentence(report))]
    if assumptions.profile is not None:
        rows.append(("noise model", f"profile {assumptions.profile.name}: {_noise_text(report)}"))
    if fix.normalised_residual is not None:
        rows.append(("residuals", f"{math.sqrt(fix.normalised_residual):.3f} of what the noise model predicts"))
    widened = f"all widened {fix.rescaled_by:.2f} times, by the residuals" if fix.rescaled_by > 1.0 else "not widened"
    rows.append(("95 % intervals", f"± {report.interval:.3f} standard deviations, {widened}"))
    bias = result["bias_dph"]
    shown = ", ".join(f"{each:z.3f}" for each in (bias if isinstance(bias, list) else [bias]))
    rows.append(("bias", f"{shown} deg/h".replace("-", "−")))
    if result["scale_factor"] is not None:
        rows.append(
            ("scale factor", f"{result['scale_factor']:.4f} ± {report.interval * result['scale_factor_sd']:.4f}")
        )
    if "calibration" in result:
        applied = result["calibration"]
        rows.append(("calibration", f"{applied['date']}, valid until {applied['valid_until']}: {applied['model']}"))
    if "closed_form" in result:
        rows.append(("published formulas", _closed_form_text(result["closed_form"])))
    rows += [("note", note) for note in result.get("notes", [])]
    return [(name, printable(value, max_length=_MAX_TEXT)) for name, value in rows]


def _estimate_sentence(report: RecordReport) -> str:
    fix, assumptions = report.fix, report.assumptions
    if fix is None or assumptions is None:
        return ""
    kind = "generalised" if assumptions.method == "generalised" and report.noise is not None else "ordinary"
    what = "means of 1 s" if kind == "generalised" else "means of the dwells"
    given = "" if assumptions.latitude_deg is None else f", latitude given as {assumptions.latitude_deg:g}°"
    left_out = f", {fix.n_rejected} left out as disturbed" if fix.n_rejected else ""
    return f"{kind} least squares of {fix.n_means} {what}, {fix.dof} degrees of freedom{left_out}{given}"


def _noise_text(report: RecordReport) -> str:
    table = report.assumptions.profile.noise if report.assumptions and report.assumptions.profile else None
    names = {
        "angle_white_noise_dph_s": ("angle white noise", "deg/h·s"),
        "angle_random_walk_deg_per_sqrt_h": ("angle random walk", "deg/√h"),
        "bias_instability_dph": ("bias instability", "deg/h"),
        "rate_random_walk_dph_per_sqrt_h": ("rate random walk", "deg/h/√h"),
        "rate_ramp_dph_per_h": ("rate ramp", "deg/h/h"),
    }
    parts = [f"{name} {getattr(table, key):g} {unit}" for key, (name, unit) in names.items() if getattr(table, key, 0)]
    return ", ".join(parts) or "none stated"


def _closed_form_text(table: dict[str, Any]) -> str:
    """Return what formulas (2) and (3) give, which know nothing of noise, nor of drift rates that gravity brings."""
    text = f"azimuth {direction_text(table['azimuth_deg'], 3)}°{_plus_minus(table['azimuth_sd_deg'])} by (2)"
    if table["latitude_deg"] is None:
        return text
    latitude = f"latitude {signed(table['latitude_deg'], 3)}{_plus_minus(table['latitude_sd_deg'])} by (3)"
    return f"{text}, {latitude}, nothing corrected; for comparison only"


def _plus_minus(sd_deg: float | None) -> str:
    return "" if sd_deg is None else f" ± {_HALF * sd_deg:.3f}°"


def event_rows(report: RecordReport) -> tuple[list[tuple[str, str, str]], int]:
    """Return (time, kind, detail) of what happened, and how many more there are than are listed."""
    rows = [
        (moment(time), printable(kind), printable(detail, max_length=_MAX_TEXT)) for time, kind, detail in report.events
    ]
    return rows, report.n_events - len(rows)


def moment(time: float) -> str:
    """Return an instant in s since 1970 as UTC to the second; a clock that cannot be read as a number of seconds."""
    try:
        return dt.datetime.fromtimestamp(time, dt.UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, OSError, ValueError):
        return f"{time:g} s"
