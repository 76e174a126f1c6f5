"""``northfinder records``: which records there are."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from northfinder.cli.show import print_json
from northfinder.record.summary import list_records
from northfinder.text import printable

_STYLE = {"complete": "green", "being written": "cyan", "ends early": "yellow", "damaged": "red"}


@click.command("records")
@click.argument("folder", type=click.Path(path_type=Path), default=Path("records"), metavar="[DIR]")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(*, folder: Path, as_json: bool) -> None:
    """List the records in DIR, by default records/, the newest first.

    \b
      northfinder records
      northfinder records /media/survey --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    lines = list_records(folder)
    if as_json:
        print_json({"records": lines})
        return
    table = Table(Column("record", no_wrap=True), "state", "plan", "steps", "azimuth, deg", "MB", box=SIMPLE)
    for line in lines:
        table.add_row(*_cells(line))
    Console().print(table if lines else f"no records in {safe(folder)}")


def _cells(line: dict[str, Any]) -> tuple[str, ...]:
    style = _STYLE[line["state"]]
    return (
        safe(Path(line["record"]).name),
        f"[{style}]{line['state']}[/{style}]",
        safe(line["plan"] or ""),
        safe(str(line["steps"] or "").removesuffix(" steps").replace(" of the ", "/")),
        with_sd(line["azimuth_deg"], line["azimuth_sd_deg"]),
        f"{line['size_bytes'] / 1e6:.1f}",
    )


def utc_text(instant: float) -> str:
    """Return s since 1970 as date and time; as it stands if it is no date."""
    try:
        return f"{datetime.fromtimestamp(instant, UTC):%Y-%m-%d %H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return f"{instant:g} s"


def safe(value: object) -> str:
    """Return foreign text such that it is shown as it stands, and does nothing."""
    return escape(printable(str(value)))


def with_sd(value: object, sd: object) -> str:
    """Return a value with its standard deviation, nothing if they are no numbers."""
    if not isinstance(value, float | int) or not isinstance(sd, float | int):
        return ""
    return f"{value:.3f} ± {sd:.3f}"
