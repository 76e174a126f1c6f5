"""``northfinder check``: whether a record is sound."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from northfinder.cli import EXIT_RECORD
from northfinder.cli.options import FILE
from northfinder.cli.show import print_json
from northfinder.errors import RecordError
from northfinder.record.check import Examination, examine
from northfinder.text import printable


@click.command("check")
@click.argument("records", nargs=-1, required=True, type=FILE, metavar="RECORD...")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(*, records: tuple[Path, ...], as_json: bool) -> int:
    """Check the file, the seal of every row, missing rows and gaps in the samples of each RECORD.

    Ends with exit code 0 if all are sound, 5 if any is damaged or is no record. Samples that never came are no damage.

    \b
      northfinder check records/*.sqlite
      northfinder check records/*.sqlite --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    found: list[dict[str, Any]] = []
    for path in dict.fromkeys(records):
        each = _examined(path, aloud=not as_json)
        found.append({"record": str(path), "sound": each.sound, "found": each})
    if as_json:
        print_json({"records": found})
    return 0 if all(each["sound"] for each in found) else EXIT_RECORD


def _examined(path: Path, *, aloud: bool) -> Examination:
    """Examine one record, and say what was found; what is no record is no reason to leave out the others."""
    try:
        found = examine(path)
    except RecordError as error:
        click.echo(f"northfinder: {printable(str(error), max_length=1000)}", err=True)
        return Examination(damage=[str(error)])
    if aloud:
        sys.stdout.write("".join(f"{printable(line, max_length=1000)}\n" for line in _lines(str(path), found)))
        sys.stdout.flush()
    return found


def _lines(path: str, found: Examination) -> list[str]:
    """Return what there is to say of one record."""
    verdict = "sound" if found.sound else "DAMAGED: northfinder recover saves what is left"
    never = f", {found.n_missing} never came" if found.n_missing else ""
    return [
        f"{path}: {verdict}",
        f"  {found.n_rows} rows as they were written, {found.n_samples} samples{never}",
        *(f"  damage: {sentence}" for sentence in found.damage),
        *(f"  note: {sentence}" for sentence in found.notes),
    ]
