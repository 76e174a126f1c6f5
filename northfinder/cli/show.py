"""Results on standard output: a panel for people, one JSON object for programs."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec
from rich.console import Console
from rich.panel import Panel
from rich.table import Table

from northfinder.budget_report import largest
from northfinder.errors import EstimateError
from northfinder.text import printable


def print_json(value: object) -> None:
    """Print `value` as one line of JSON."""
    sys.stdout.write(msgspec.json.encode(value).decode() + "\n")
    sys.stdout.flush()


def print_result(result: Mapping[str, Any], *, truth: tuple[float, float] | None = None) -> None:
    """Print a fix as a panel; `truth` is the emulator's (azimuth, latitude) in deg."""
    table = Table.grid(padding=(0, 2))
    table.add_row("azimuth", f"[bold]{_with_sd(result['azimuth_deg'], result['azimuth_sd_deg'])}[/bold]")
    table.add_row("latitude", _latitude(result))
    for row in _bearings(result):
        table.add_row(*row)
    if truth is not None:
        table.add_row("truth", f"azimuth {truth[0]:g} deg, latitude {truth[1]:g} deg, in the emulator")
    biases = result["bias_dph"] if isinstance(result["bias_dph"], list) else [result["bias_dph"]]
    table.add_row("bias", ", ".join(f"{bias:.3f}" for bias in biases) + " deg/h")
    if result["scale_factor"] is not None:
        table.add_row("scale factor", f"{result['scale_factor']:.4f} ± {result['scale_factor_sd']:.4f}")
    for row in _notes(result):
        table.add_row(*row)
    for check in result["checks"]:
        mark = "[green]pass[/green]" if check["passed"] else "[red]FAIL[/red]"
        table.add_row(mark, printable(check["sentence"]))
    if "n_samples" in result:
        table.add_row("samples", f"{result['n_samples']} in {result['duration_s']:.1f} s, {result['n_lost']} lost")
    if "record" in result:
        if not result.get("complete", True):
            table.add_row("record", f"[red]ends before the measurement did, {result['steps']}[/red]")
        table.add_row("record", printable(result["record"]))
    Console().print(Panel(table, title="true north", expand=False))


def _latitude(result: Mapping[str, Any]) -> str:
    if result["latitude_deg"] is None:
        return f"not measured: {result['latitude_reason']}"
    if result["latitude_sd_deg"] == 0:
        return f"{result['latitude_deg']:.3f} deg, as given"
    return f"[bold]{_with_sd(result['latitude_deg'], result['latitude_sd_deg'])}[/bold]"


def _bearings(result: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what the azimuth is on a map and by a compass, or why it is not known, where a position was given."""
    if "position" not in result:
        return
    grid, magnetic = result["grid"], result["magnetic"]
    if "reason" in grid:
        yield "grid azimuth", f"none: {printable(grid['reason'])}"
    else:
        yield "grid azimuth", f"[bold]{_with_sd(grid['azimuth_deg'], grid['azimuth_sd_deg'])}[/bold]"
        yield "", f"convergence {grid['convergence_deg']:.4f} deg, {printable(grid['name'])} (EPSG:{grid['epsg']})"
    if "reason" in magnetic:
        yield "magnetic", f"none: {printable(magnetic['reason'])}"
        return
    yield "magnetic", f"[bold]{_with_sd(magnetic['bearing_deg'], magnetic['bearing_sd_deg'])}[/bold]"
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
        yield "note", note


def require_trustworthy(result: Mapping[str, Any]) -> None:
    """Raise EstimateError if a decisive check of the fix has failed: its figures must not be relied on."""
    checks = result.get("checks", [])
    failed = [check["sentence"] for check in checks if check["decisive"] and not check["passed"]]
    if failed:
        raise EstimateError(f"no trustworthy estimate: {failed[0]}")


def _with_sd(value: float, sd: float) -> str:
    return f"{value:.3f} ± {sd:.3f} deg"
