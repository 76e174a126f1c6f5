"""``northfinder report``: a record as a page, as pictures, or as data; many records as the page of a campaign."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import click
import msgspec

from northfinder.cli.options import position_options
from northfinder.errors import ConfigError, RecordError
from northfinder.geodesy import Place

Format = Literal["html", "svg", "png", "pdf", "json", "md"]

FORMATS: tuple[Format, ...] = ("html", "svg", "png", "pdf", "json", "md")
PARTS = ("overview", "compass", "rate", "residuals", "allan", "stage", "tilt", "temperature")
_SQLITE = b"SQLite format 3\0"
_STANDARD_OUTPUT = "-"


@click.command("report")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RECORD...")
@click.option(
    "-o", "--output", metavar="FILE|-", help="If not given, beside the record, with the format as its suffix."
)
@click.option(
    "--format", "given_format", type=click.Choice(FORMATS), help="If not given, by the suffix of the output, or html."
)
@click.option(
    "--part", type=click.Choice(PARTS), default="overview", show_default=True, help="What an svg or png shows."
)
@position_options
def command(
    *,
    files: Sequence[Path],
    output: str | None,
    given_format: Format | None,
    part: str,
    position: str | None,
    epsg: int | None,
) -> None:
    """Write the report of a record of find, or of a campaign of several.

    The html needs no network and no other file, and prints on A4.

    \b
      northfinder report records/north-20260101T120000.000000Z.sqlite
      northfinder report RECORD --position 50.429,30.523 -o north.html
      northfinder report RECORD --part rate -o rate.svg
      northfinder report records/*.sqlite -o campaign.html
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    kind = given_format or _format_of(output)
    place = Place.of(position, epsg)
    if len(files) == 1:
        content = _of_record(files[0], place, kind, part)
        default = files[0].with_suffix(f".{kind}")
    else:
        if place is not None:
            raise ConfigError("--position is for the report of one record: a campaign compares true azimuths")
        content = _of_campaign(files, kind)
        default = files[0].parent / f"campaign.{kind}"
    if output == _STANDARD_OUTPUT:
        sys.stdout.buffer.write(content)
        sys.stdout.flush()
        return
    path = default if output is None else Path(output)
    write_new(path, content)
    click.echo(str(path))


def _format_of(output: str | None) -> Format:
    suffix = "" if output is None else Path(output).suffix.removeprefix(".").lower()
    return next((each for each in FORMATS if each == suffix), "html")


def _of_record(path: Path, place: Place | None, kind: Format, part: str) -> bytes:
    from northfinder.report.gather import gather_record  # noqa: PLC0415  # heavy, and only for one record

    report = gather_record(path, place)
    if kind == "pdf":
        from northfinder.report.paper import record_pdf  # noqa: PLC0415  # drawing is dear to import

        return record_pdf(report)
    if kind in {"svg", "png"}:
        from northfinder.report import figures  # noqa: PLC0415  # drawing is dear to import

        try:
            return figures.picture(report, part, kind)
        except KeyError:
            raise RecordError(f"the record {path} has nothing to draw as --part {part}") from None
    from northfinder.report import document, page  # noqa: PLC0415  # only now it is known that they are needed

    if kind == "json":
        return msgspec.json.encode(document.record_json(report)) + b"\n"
    return (document.record_markdown(report) if kind == "md" else page.record_page(report)).encode()


def _of_campaign(files: Sequence[Path], kind: Format) -> bytes:
    from northfinder.campaign import gather, read_member  # noqa: PLC0415  # only for many records
    from northfinder.campaign_report import campaign_json  # noqa: PLC0415
    from northfinder.report import campaign  # noqa: PLC0415

    result = campaign_json(gather([read_member(path) for path in files]))
    if kind in {"svg", "png", "pdf"}:
        from northfinder.report.figures import charts_picture  # noqa: PLC0415  # drawing is dear to import

        return charts_picture(campaign.campaign_charts(result), kind)
    if kind == "json":
        return msgspec.json.encode(result) + b"\n"
    return (campaign.campaign_markdown(result) if kind == "md" else campaign.campaign_page(result)).encode()


def write_new(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all; an older report is replaced, a record never.

    Raises RecordError if it cannot be written, ConfigError if a database stands there.
    """
    try:
        if path.is_file():
            with path.open("rb") as file:
                if file.read(len(_SQLITE)) == _SQLITE:
                    raise ConfigError(f"the output {path} is a database, perhaps a record: nothing is written over it")
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            part.write_bytes(content)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise RecordError(f"the report {path} cannot be written: {error.strerror}") from None
