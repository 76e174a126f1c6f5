"""``northfinder allan``: the noise of a gyro from a recording at rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from northfinder.cli.show import print_json, safe
from northfinder.errors import EstimateError
from northfinder.estimation.allan import AllanCurve, allan_curve
from northfinder.estimation.noise_identification import Identification, identify
from northfinder.noise_report import FIELDS, decades, in_field_units, noise_json, save_profile
from northfinder.rate_files import RateSelection, RateSeries, read_rate_file
from northfinder.text import printable
from northfinder.units import DPH

_POSITIVE = click.FloatRange(min=0.0, min_open=True)


#: A profile serves measurements of some minutes; what is identified from less says nothing of their drift, in s.
SHORTEST_FOR_PROFILE = 600.0
#: Relative departure of the spectrum from the model beyond which it is no model of it.
GREATEST_MODEL_ERROR = 0.5


@click.command("allan")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--sample-rate", type=_POSITIVE, metavar="HZ", help="Sample rate, where the file does not tell.")
@click.option("--column", metavar="NAME", help="Column or array of the rate, where the file holds several.")
@click.option("--axis", type=click.IntRange(min=1), default=1, show_default=True, metavar="N", help="Input axis.")
@click.option("--scale", "scale_dph", type=_POSITIVE, metavar="DPH", help="deg/h in one step, for a rate in counts.")
@click.option("--skip", type=click.FloatRange(min=0.0), default=0.0, metavar="S", help="Leave out the warm-up.")
@click.option("--save", type=click.Path(path_type=Path), metavar="PROFILE.toml", help="Save a gyro profile.")
@click.option("--name", help="Name of the profile; that of its file by default.")
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.svg", help="Draw the Allan deviation.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(
    *,
    file: Path,
    sample_rate: float | None,
    column: str | None,
    axis: int,
    scale_dph: float | None,
    skip: float,
    save: Path | None,
    name: str | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Identify the noise of a gyro from FILE, recorded at rest: a record of find, CSV, or a NumPy archive.

    Prints the Allan deviation and the noise coefficients with their standard deviations. A longer record shows slower
    noise: take four hours for what matters within one.

    \b
      northfinder allan records/north-20260101T120000.000000Z.sqlite --save mine.toml
      northfinder allan rates.csv --column gyro_x_dph --sample-rate 100 --plot allan.svg
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    scale = None if scale_dph is None else scale_dph * DPH
    series = read_rate_file(
        file, RateSelection(column=column, axis=axis, sample_rate=sample_rate, scale=scale, skip=skip)
    )
    identified = identify(series.rate, series.sample_rate)
    curve = allan_curve(series.rate, series.sample_rate, identified.noise)
    result = {"file": str(file)} | noise_json(series, identified, curve)
    if save is not None:
        _require_worth_saving(series, identified)
        save_profile(save, save.stem if name is None else name, series, identified)
        result["profile"] = str(save)
    if plot is not None:
        from northfinder.cli.plot_allan import plot_allan  # noqa: PLC0415  # drawing is dear to import

        plot_allan(plot, f"{printable(file.name)}, {series.duration:.0f} s at {series.sample_rate:g} Hz", result)
    if as_json:
        print_json(result)
    else:
        _print(series, identified, curve, result)


def _require_worth_saving(series: RateSeries, identified: Identification) -> None:
    """Raise EstimateError if a profile of this record would mislead every later fix."""
    if series.duration < SHORTEST_FOR_PROFILE:
        raise EstimateError(
            f"a profile needs at least {SHORTEST_FOR_PROFILE:g} s at rest, and this record holds "
            f"{series.duration:.0f} s: nothing was saved"
        )
    if identified.model_error > GREATEST_MODEL_ERROR:
        raise EstimateError(
            f"the spectrum departs from the five kinds of noise by {100 * identified.model_error:.0f} %: something "
            "else than the gyro's noise is in the record, and nothing was saved"
        )


def _print(series: RateSeries, identified: Identification, curve: AllanCurve, result: dict[str, Any]) -> None:
    console = Console()
    console.print(
        f"{series.rate.size} samples, {series.duration:.1f} s at {series.sample_rate:g} Hz,"
        f" mean rate {result['mean_rate_dph']:.4g} deg/h"
    )
    for note in series.notes:
        console.print(f"[yellow]note[/yellow] {safe(note)}")
    console.print(_coefficients(identified))
    if identified.model_error:
        console.print(
            f"The spectrum departs from these five kinds of noise by {100.0 * identified.model_error:.1f} % (rms over"
            " bands); the standard deviations allow for it."
        )
    console.print(_deviations(curve, result["allan"]))
    if "profile" in result:
        console.print(f"profile saved: {safe(result['profile'])}")


def _coefficients(identified: Identification) -> Table:
    table = Table("coefficient", "value", "sd", "at most", "unit", title="noise")
    for each in identified.coefficients:
        values, unit = in_field_units(each), FIELDS[each.name][1]
        name = each.name.replace("_", " ")
        if each.observable:
            table.add_row(name, f"{values['value']:.4g}", f"{values['sd']:.2g}", "", unit)
        else:
            table.add_row(name, "0", "not observable", f"{values['upper_bound']:.2g}", unit)
    return table


def _deviations(curve: AllanCurve, allan: dict[str, Any]) -> Table:
    band = f"{100.0 * curve.confidence:.0f} % band"
    table = Table("averaging time, s", "Allan deviation, deg/h", band, "fitted", title="Allan deviation")
    for i in decades(curve):
        table.add_row(
            f"{allan['tau_s'][i]:.4g}",
            f"{allan['deviation_dph'][i]:.4g}",
            f"{allan['low_dph'][i]:.4g} .. {allan['high_dph'][i]:.4g}",
            f"{allan['model_dph'][i]:.4g}",
        )
    return table
