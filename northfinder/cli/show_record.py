"""``northfinder show``: all of a record but its samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from northfinder.cli.options import FILE
from northfinder.cli.records import utc_text, with_sd
from northfinder.cli.show import print_json, safe
from northfinder.record.summary import page

_MAX_EVENTS = 200


@click.command("show")
@click.argument("record", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output, with all that there is.")
def command(*, record: Path, as_json: bool) -> None:
    """Show what RECORD holds: devices, plan, steps, events, notes and fix.

    \b
      northfinder show records/north-20260101T120000.000000Z.sqlite
      northfinder show records/north-20260101T120000.000000Z.sqlite --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    found = page(record)
    if as_json:
        print_json(found)
        return
    console = Console()
    console.print(_facts(found))
    if found["step_list"]:
        console.print(_steps(found))
    console.print(_events(found))


def _facts(found: Mapping[str, Any]) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_row("record", safe(found["record"]))
    table.add_row("state", f"{found['state']}, {safe(found['steps'])}")
    if found["started_utc_s"] is not None:
        table.add_row("begun", f"{utc_text(found['started_utc_s'])} UTC")
    for kind, device in _devices(found["meta"].get("identities")):
        table.add_row(safe(kind), safe(device))
    table.add_row("plan", safe(found["plan"] or ""))
    table.add_row("software", safe(found["meta"].get("northfinder") or ""))
    table.add_row("streams", f"{len(found['streams'])}, {found['n_blocks']} blocks of samples")
    for name in ("azimuth", "latitude"):
        value = with_sd(found[f"{name}_deg"], found[f"{name}_sd_deg"])
        if value:
            table.add_row(name, f"{value} deg")
    if found["trustworthy"] is False:
        table.add_row("", "[red]not to be trusted: a decisive check has failed, northfinder solve says which[/red]")
    return table


def _devices(identities: object) -> list[tuple[str, str]]:
    if not isinstance(identities, dict):
        return []
    names = ("model", "serial_number", "firmware_version", "protocol")
    return [
        (kind, " ".join(str(device[name]) for name in names if device.get(name)))
        for kind, device in identities.items()
        if isinstance(device, dict)
    ]


def _steps(found: Mapping[str, Any]) -> Table:
    table = Table("step", "position", "azimuth, deg", "elevation, deg", "seconds", "stream", box=SIMPLE)
    for span in found["step_list"]:
        seconds = (span.stop_index - span.first_index) / span.sample_rate if span.sample_rate else math.nan
        angles = (math.degrees(span.measured_azimuth), math.degrees(span.measured_elevation))
        table.add_row(
            str(span.step + 1), safe(span.name), f"{angles[0]:.4f}", f"{angles[1]:.4f}", f"{seconds:.1f}",
            str(span.stream),
        )  # fmt: skip
    return table


def _events(found: Mapping[str, Any]) -> Table:
    table = Table("UTC", "event", "", box=SIMPLE)
    told = [event for event in found["events"] if event["kind"] != "state"]
    for event in told[:_MAX_EVENTS]:
        table.add_row(utc_text(event["utc_s"]), safe(event["kind"]), safe(event["detail"]))
    if len(told) > _MAX_EVENTS:
        table.add_row("", f"and {len(told) - _MAX_EVENTS} more", "")
    return table
