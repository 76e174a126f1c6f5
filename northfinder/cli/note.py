"""``northfinder note``: what the operator has to say of a measurement."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import click

from northfinder.record.notes import MAX_NOTE, add_note
from northfinder.record.summary import newest_record
from northfinder.text import printable


@click.command("note")
@click.argument("text")
@click.argument("record", required=False, type=click.Path(path_type=Path))
@click.option("--in", "folder", type=click.Path(path_type=Path), default=Path("records"), show_default=True,
              metavar="DIR", help="Where to look for the newest record.")  # fmt: skip
def command(*, text: str, record: Path | None, folder: Path) -> None:
    """Add TEXT with the present time to RECORD, by default the newest one; also while it is being written.

    \b
      northfinder note "a lorry passed"
      northfinder note "line to the church tower" records/north-20260101T120000.000000Z.sqlite
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    if not text.strip() or len(text) > MAX_NOTE:
        raise click.BadParameter(f"expected 1 to {MAX_NOTE} characters", param_hint="TEXT")
    path = record or newest_record(folder)
    add_note(path, text, now=time.time())
    sys.stdout.write(f"noted in {printable(str(path))}\n")
