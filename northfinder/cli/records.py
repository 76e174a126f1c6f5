"""``northfinder records``: which records there are."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape

from northfinder.cli.options import FILE
from northfinder.cli.show import print_json, safe
from northfinder.record.summary import MAX_LISTED, list_records
from northfinder.text import printable

_STYLE = {"complete": "green", "being written": "cyan", "ends early": "yellow", "damaged": "red"}
_HEAD = ("azimuth, deg", "plan", "MB", "record")
#: The longest name of a plan of ours: with it a line has 80 characters at the most, if find has named the record.
_PLAN_WIDTH = 14


@click.command("records")
@click.argument("folder", type=FILE, default=Path("records"), metavar="[DIR]")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output, with more of each record.")
def command(*, folder: Path, as_json: bool) -> None:
    """List the records in DIR, by default records/, the newest first.

    In place of the azimuth of a record without a fix stands why there is none; an azimuth with ! must not be trusted,
    since a decisive check of its fix has failed. Names come last and are never cut.

    \b
      northfinder records
      northfinder records /media/survey
      northfinder records /media/survey --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    lines = list_records(folder)
    if as_json:
        print_json({"records": lines})
        return
    console = Console(highlight=False)
    if not lines:
        console.print(f"no records in {safe(folder)}", soft_wrap=True)
        return
    for line in _aligned(lines):
        console.print(line, soft_wrap=True)  # the terminal's business, if it is narrower; a pipe has no width
    if len(lines) == MAX_LISTED:
        click.echo(f"only the newest {MAX_LISTED} are listed", err=True)
    if console.is_terminal and any(line["state"] == "damaged" for line in lines):
        console.print("northfinder check says what is wrong with a damaged one")


def _aligned(lines: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the head and a line for each record, all cells of a column equally wide."""
    rows = [_cells(line) for line in lines]
    widths = [max(map(cell_len, column)) for column in zip(_HEAD, *rows, strict=True)]
    styles = ("bold", *("red" if line["trustworthy"] is False else _STYLE[line["state"]] for line in lines))
    for style, (outcome, plan, size, name) in zip(styles, (_HEAD, *rows), strict=True):
        first, second = _padded(outcome, widths[0]), _padded(plan, widths[1])
        yield f"[{style}]{first}[/{style}]  {second}  {size:>{widths[2]}}  {escape(name)}"


def _padded(text: str, width: int) -> str:
    """Return text as markup, filled up with blanks to a width on the screen."""
    return escape(text) + " " * (width - cell_len(text))


def _cells(line: dict[str, Any]) -> tuple[str, str, str, str]:
    return (
        _outcome(line),
        printable(str(line["plan"] or ""), max_length=_PLAN_WIDTH),
        f"{line['size_bytes'] / 1e6:.1f}",
        printable(Path(line["record"]).name, max_length=1000),
    )


def _outcome(line: dict[str, Any]) -> str:
    """Return the azimuth, or else how far the measurement came."""
    if line["state"] == "complete":
        mark = " !" if line["trustworthy"] is False else ""
        return (with_sd(line["azimuth_deg"], line["azimuth_sd_deg"], width=7) or "complete") + mark
    steps = str(line["steps"] or "").removesuffix(" steps").replace(" of the ", "/")
    return f"{line['state']}, {steps}" if "/" in steps else str(line["state"])


def utc_text(instant: float) -> str:
    """Return s since 1970 as date and time; as it stands if it is no date."""
    try:
        return f"{datetime.fromtimestamp(instant, UTC):%Y-%m-%d %H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return f"{instant:g} s"


def with_sd(value: object, sd: object, *, width: int = 0) -> str:
    """Return a value with its standard deviation, nothing if they are no numbers."""
    if not isinstance(value, float | int) or not isinstance(sd, float | int):
        return ""
    return f"{value:{width}.3f} ± {sd:.3f}"
