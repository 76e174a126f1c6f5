"""``northfinder note``: what the operator has to say of a measurement."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import click

from northfinder.cli.options import FILE
from northfinder.cli.show import print_json
from northfinder.record.notes import MAX_NOTE, add_note
from northfinder.record.summary import newest_record
from northfinder.text import printable


@click.command("note")
@click.argument("text")
@click.argument("record", required=False, type=FILE)
@click.option("--in", "folder", type=click.Path(path_type=Path), default=Path("records"), show_default=True,
              metavar="DIR", help="Where to look for the newest record.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output: the record and the text.")
def command(*, text: str, record: Path | None, folder: Path, as_json: bool) -> None:
    """Add TEXT with the present time to RECORD, by default the newest one; also while it is being written.

    \b
      northfinder note "a lorry passed"
      northfinder note "line to the church tower" records/north-20260101T120000.000000Z.sqlite
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    line = " ".join(text.split())
    if not any(map(str.isprintable, line)) or len(line) > MAX_NOTE:
        found = f"{len(line)} characters" if line else "nothing to read"
        raise click.BadParameter(f"found {found}, expected 1 to {MAX_NOTE} characters", param_hint="TEXT")
    if record is None and os.path.isfile(text):  # noqa: PTH113  # Path.is_file raises where a name is too long
        raise click.BadParameter(
            f"found the name of a file, {text!r}, expected what there is to note", param_hint="TEXT"
        )
    path = record or newest_record(folder)
    add_note(path, line, now=time.time())
    if as_json:
        print_json({"record": str(path), "text": line})
        return
    sys.stdout.write(f"noted in {printable(str(path))}\n")
