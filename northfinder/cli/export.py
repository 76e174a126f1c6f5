"""``northfinder export``: the samples of a record for other programs."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from northfinder.cli.options import FILE
from northfinder.cli.show import print_json
from northfinder.export import FORMATS, export_record
from northfinder.record import Record
from northfinder.text import printable


@click.command("export")
@click.argument("file", type=FILE, metavar="RECORD")
@click.option("--to", "kind", type=click.Choice(list(FORMATS)), required=True, help="Which kind of file.")
@click.option("-o", "--out", type=FILE, metavar="FILE", help="By default beside RECORD.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output: the file, how many samples.")
def command(*, file: Path, kind: str, out: Path | None, as_json: bool) -> None:
    """Write every sample of RECORD, with what was measured beside it, to a new file.

    Units stand in the names of the columns, docs/record.md; nothing is rounded.

    \b
      northfinder export records/north-20260101T120000.000000Z.sqlite --to parquet
      northfinder export records/north-20260101T120000.000000Z.sqlite --to csv -o samples.csv
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    out = out or file.parent / f"{file.stem}.{kind}"
    with Record(file) as record:
        n_samples = export_record(record, out, kind)
    if as_json:
        print_json({"file": str(out), "n_samples": n_samples})
        return
    sys.stdout.write(f"{n_samples} samples written to {printable(str(out))}\n")
