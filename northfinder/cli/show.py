"""Results on standard output: a panel for people, one JSON object for programs."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from northfinder.angles import direction_text
from northfinder.budget_report import largest
from northfinder.errors import EstimateError
from northfinder.text import json_text, printable

#: A note longer than this is cut.
_MAX_NOTE = 500


def safe(value: object, *, max_length: int = 500) -> str:
    """Return what a file or a device says such that a terminal shows it as it stands, and does nothing."""
    return escape(printable(str(value), max_length=max_length))


def print_json(value: object) -> None:
    """Print `value` as one line of JSON."""
    sys.stdout.write(json_text(value) + "\n")
    sys.stdout.flush()


def print_result(result: Mapping[str, Any], *, truth: tuple[float, float] | None = None) -> None:
    """Print a fix as a panel; `truth` is the emulator's (azimuth, latitude) in deg."""
    table = Table.grid(padding=(0, 2))
    for label, value in _rows(result, truth):
        # As texts: what a file or a device says is no markup.
        table.add_row(label, value if isinstance(value, Text) else Text(value))
    panel = Panel(table, title="true north", subtitle="each ± is one standard deviation", expand=False)
    Console().print(panel)


def _rows(result: Mapping[str, Any], truth: tuple[float, float] | None) -> Iterator[tuple[str | Text, str | Text]]:
    """Yield what the panel says, as (label, value)."""
    yield "azimuth", _bold(_direction(result["azimuth_deg"], result["azimuth_sd_deg"]))
    yield "latitude", _latitude(result)
    yield from _bearings(result)
    if truth is not None:
        yield "truth", f"azimuth {truth[0]:g} deg, latitude {truth[1]:g} deg, in the emulator"
    biases = result["bias_dph"] if isinstance(result["bias_dph"], list) else [result["bias_dph"]]
    yield "bias", ", ".join(f"{bias:z.3f}" for bias in biases) + " deg/h"
    if result["scale_factor"] is not None:
        yield "scale factor", f"{result['scale_factor']:.4f} ± {result['scale_factor_sd']:.4f}"
    yield from _notes(result)
    for check in result["checks"]:
        yield _verdict(check), printable(check["sentence"])
    if "n_samples" in result:
        yield "samples", f"{result['n_samples']:,} in {result['duration_s']:.1f} s, {result['n_lost']:,} lost"
    if "record" in result:
        if not result.get("complete", True):
            yield "record", Text(f"ends before the measurement did, {result['steps']}", style="red")
        yield "record", printable(result["record"])


def _verdict(check: Mapping[str, Any]) -> Text:
    """Return the outcome of a check; one that is not decisive warns."""
    if check["passed"]:
        return Text("pass", style="green")
    return Text("FAIL", style="red") if check["decisive"] else Text("warning", style="yellow")


def _latitude(result: Mapping[str, Any]) -> str | Text:
    if result["latitude_deg"] is None:
        return f"not measured: {result['latitude_reason']}"
    if result["latitude_sd_deg"] == 0:
        return f"{result['latitude_deg']:z.3f} deg, as given"
    return _bold(_with_sd(result["latitude_deg"], result["latitude_sd_deg"]))


def _bearings(result: Mapping[str, Any]) -> Iterator[tuple[str, str | Text]]:
    """Yield what the azimuth is on a map and by a compass, or why it is not known, where a position was given."""
    if "position" not in result:
        return
    grid, magnetic = result["grid"], result["magnetic"]
    if "reason" in grid:
        yield "grid azimuth", f"none: {printable(grid['reason'])}"
    else:
        yield "grid azimuth", _bold(_direction(grid["azimuth_deg"], grid["azimuth_sd_deg"]))
        yield "", f"convergence {grid['convergence_deg']:z.4f} deg, {printable(grid['name'])} (EPSG:{grid['epsg']})"
    if "reason" in magnetic:
        yield "magnetic", f"none: {printable(magnetic['reason'])}"
        return
    yield "magnetic", _bold(_direction(magnetic["bearing_deg"], magnetic["bearing_sd_deg"]))
    declination = _with_sd(magnetic["declination_deg"], magnetic["declination_sd_deg"])
    yield "", f"declination {declination} on {magnetic['date']}"
    yield "", f"by {magnetic['model']}, which holds from {magnetic['valid_from']} to {magnetic['valid_until']}"


def _notes(result: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what there is to say of how the fix came about."""
    if result["n_rejected"]:
        yield "left out", f"{result['n_rejected']} disturbed seconds"
    if result["rescaled_by"] > 1:
        yield "widened", f"residuals are larger than usual: the ± are widened {result['rescaled_by']:.2f} times"
    if "levelling" in result:
        tilt = result["levelling"]
        x_y = f"{tilt['tilt_x_deg']:.4f}, {tilt['tilt_y_deg']:.4f} ± {tilt['tilt_sd_deg']:.4f} deg"
        yield "tilt", f"{x_y}, by the accelerometers"
    if "budget" in result:
        yield "uncertainty", f"of the azimuth, the largest parts: {largest(result['budget'])} deg"
    if "calibration" in result:
        applied = result["calibration"]
        yield "calibration", f"of {applied['date']}, valid until {applied['valid_until']}: {applied['model']}"
    for note in result.get("notes", []):
        yield "note", printable(note, max_length=_MAX_NOTE)


def require_trustworthy(result: Mapping[str, Any]) -> None:
    """Raise EstimateError if a decisive check of the fix has failed: its figures must not be relied on."""
    checks = result.get("checks", [])
    failed = [check["sentence"] for check in checks if check["decisive"] and not check["passed"]]
    if failed:
        raise EstimateError(f"no trustworthy estimate: {failed[0]}")


def _bold(text: str) -> Text:
    return Text(text, style="bold")


def _direction(angle_deg: float, sd_deg: float) -> str:
    return f"{direction_text(angle_deg, 3)} ± {sd_deg:.3f} deg"


def _with_sd(value: float, sd: float) -> str:
    return f"{value:z.3f} ± {sd:.3f} deg"
