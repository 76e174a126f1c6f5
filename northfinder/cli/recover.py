"""``northfinder recover``: a damaged record to a new one."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from northfinder.cli.options import FILE
from northfinder.cli.show import print_json
from northfinder.record.recovery import recover
from northfinder.text import printable


@click.command("recover")
@click.argument("record", type=FILE)
@click.option("-o", "--out", type=FILE, metavar="FILE", help="By default RECORD with -recovered.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(*, record: Path, out: Path | None, as_json: bool) -> None:
    """Save every sound row of a torn or damaged RECORD to a new one, and say what is lost.

    RECORD itself is never changed; the log beside it, FILE-wal, is read too if there is one.

    \b
      northfinder recover records/north-20260101T120000.000000Z.sqlite
      northfinder recover records/north-20260101T120000.000000Z.sqlite --out saved.sqlite --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    out = out or record.parent / f"{record.stem}-recovered{record.suffix}"
    salvage = recover(record, out)
    if as_json:
        print_json({"record": str(out), "found": salvage.found, "lost": salvage.lost, "closed": salvage.closed})
        return
    sys.stdout.write("".join(f"{line}\n" for line in (*salvage.sentences(), f"written to {printable(str(out))}")))
