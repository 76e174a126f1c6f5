"""``northfinder solve``: a fix from a record or from a table of measurements."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from northfinder.calibration import read_calibration
from northfinder.cli.options import FILE, estimation_options, position_options
from northfinder.cli.show import print_json, print_result, require_trustworthy, safe
from northfinder.geodesy import Place
from northfinder.record.files import require_file
from northfinder.solution import Assumptions, Method
from northfinder.solve_file import solve_file

#: Options, and which of the assumptions that a record holds each of them changes.
_REVISED = {name: name for name in ("latitude_deg", "latitude_sd_deg", "profile", "g_drift_dph", "method")} | {
    "calibration_file": "calibration"
}


@click.command("solve")
@click.argument("file", type=FILE)
@click.option(
    "--input-axis-offset",
    "offset_deg",
    type=float,
    metavar="DEG",
    help="For a table of dwells: where the input axis points at stage azimuth zero, if not as the file says.",
)
@position_options
@estimation_options
@click.pass_context
def command(
    context: click.Context,
    *,
    file: Path,
    offset_deg: float | None,
    position: str | None,
    epsg: int | None,
    latitude_deg: float | None,
    latitude_sd_deg: float,
    calibration_file: Path | None,
    profile: str | None,
    g_drift_dph: float | None,
    method: Method,
    as_json: bool,
) -> None:
    """Estimate from FILE: a record of find, or CSV with a table of dwells or a static triad.

    A record is solved under its own assumptions and gives the fix of the live run again; each option changes one.

    \b
      northfinder solve records/north-20260101T120000.000000Z.sqlite
      northfinder solve dwells.csv --latitude 49 --input-axis-offset 180
      northfinder solve triad.csv --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    require_file(file)
    options = Assumptions.gather(
        profile=profile,
        latitude_deg=latitude_deg,
        latitude_sd_deg=latitude_sd_deg,
        g_drift_dph=g_drift_dph,
        method=method,
        calibration=None if calibration_file is None else read_calibration(calibration_file),
    )
    sources = {option: context.get_parameter_source(option) for option in _REVISED}
    changes = {
        _REVISED[option]: getattr(options, _REVISED[option])
        for option, source in sources.items()
        if source is not click.core.ParameterSource.DEFAULT
    }
    offset = None if offset_deg is None else math.radians(offset_deg)
    result = solve_file(
        file,
        None,
        revise=lambda kept: replace(kept, **changes),
        input_axis_offset=offset,
        place=Place.of(position, epsg),
    )
    if as_json:
        print_json(result)
    elif "checks" in result:
        print_result(result)
    else:
        Console().print(_table(result))
    require_trustworthy(result)


def _table(result: dict[str, Any]) -> Table:
    """Return any plain result as rows of name and value."""
    table = Table("", "", show_header=False)
    for name, value in _flat(result):
        table.add_row(safe(name), safe(value))
    return table


def _flat(value: Any, name: str = "") -> list[tuple[str, str]]:  # noqa: ANN401  # plain data of any shape
    if isinstance(value, dict):
        return [row for key, each in value.items() for row in _flat(each, f"{name}.{key}".lstrip("."))]
    if isinstance(value, list):
        return [row for number, each in enumerate(value) for row in _flat(each, f"{name}[{number}]")]
    return [(name, f"{value:.4f}" if isinstance(value, float) else "" if value is None else str(value))]
