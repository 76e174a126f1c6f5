"""``northfinder calibrate``: the constants of an instrument from records at a known latitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import msgspec
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from northfinder.calibrate import Truth, calibrate_records
from northfinder.calibration import Calibration, Model, save_calibration
from northfinder.cli.show import print_json, safe
from northfinder.errors import ConfigError
from northfinder.estimation.calibration import Constants
from northfinder.profile import find_profile


@click.command("calibrate")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RECORD...")
@click.option(
    "--latitude", "latitudes_deg", multiple=True, type=click.FloatRange(-90, 90), metavar="DEG",
    help="True latitude: once for all records, or once for each in their order. If not given, the records' own.",
)  # fmt: skip
@click.option("--latitude-sd", "latitude_sd_deg", type=click.FloatRange(min=0), default=0.0, metavar="DEG")
@click.option(
    "--azimuth", "azimuths_deg", multiple=True, type=float, metavar="DEG",
    help="True azimuth of the line that is to be measured, for its offset: once, or once for each record.",
)  # fmt: skip
@click.option("--azimuth-sd", "azimuth_sd_deg", type=click.FloatRange(min=0), default=0.0, metavar="DEG")
@click.option(
    "--model", type=click.Choice(["acceleration-sensitive", "ratio"]),
    help="Model to apply; if not given that which the data support, else acceleration-sensitive.",
)  # fmt: skip
@click.option("--profile", metavar="NAME|FILE", help="Gyro profile, instead of that of the records.")
@click.option(
    "--valid-days", type=click.IntRange(min=0), default=365, show_default=True, metavar="N",
    help="How long it may be used, from the day of the last record.",
)  # fmt: skip
@click.option("--save", type=click.Path(path_type=Path), metavar="FILE.toml", help="For find and solve --calibration.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(
    *,
    files: Sequence[Path],
    latitudes_deg: Sequence[float],
    latitude_sd_deg: float,
    azimuths_deg: Sequence[float],
    azimuth_sd_deg: float,
    model: Model | None,
    profile: str | None,
    valid_days: int,
    save: Path | None,
    as_json: bool,
) -> None:
    """Find scale factor, acceleration-sensitive drift rate, ratio of the scale factors, and offset of the azimuth.

    Records at several latitudes tell which of the two models is right: a drift rate that gravity brings, or scale
    factors that differ between the planes.

    \b
      northfinder calibrate records/*.sqlite --latitude 50.429 --save mine.toml
      northfinder calibrate kyiv.sqlite oslo.sqlite --latitude 50.4 --latitude 59.9 --azimuth 127.31 --save mine.toml
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    latitudes = _for_each("--latitude", latitudes_deg, len(files))
    azimuths = _for_each("--azimuth", azimuths_deg, len(files))
    truths = [Truth(latitude_deg=lat, azimuth_deg=azimuth) for lat, azimuth in zip(latitudes, azimuths, strict=True)]
    found = None if profile is None else find_profile(profile)
    calibration, constants = calibrate_records(
        list(zip(files, truths, strict=True)),
        valid_days=valid_days,
        latitude_sd_deg=latitude_sd_deg,
        azimuth_sd_deg=azimuth_sd_deg,
        model=model,
        revise=lambda kept: kept if found is None else replace(kept, profile=found),
    )
    if save is not None:
        save_calibration(calibration, save)
    if as_json:
        print_json(_json(calibration, constants) | {"saved": None if save is None else str(save)})
    else:
        _print(calibration, constants, save)


def _for_each(option: str, values: Sequence[float], n: int) -> list[float | None]:
    """Return a value for each record: none at all, the same one, or their own."""
    if len(values) <= 1:
        return [values[0] if values else None] * n
    if len(values) != n:
        raise ConfigError(f"{option} is given {len(values)} times for {n} records: once, or once for each")
    return list(values)


def _json(calibration: Calibration, constants: Constants) -> dict[str, Any]:
    result: dict[str, Any] = msgspec.to_builtins(calibration)
    result["acceleration_sensitive"]["probability"] = constants.acceleration_sensitive.probability
    if constants.ratio is not None:
        result["ratio"]["probability"] = constants.ratio.probability
    return result | {"verdict": _verdict(calibration)}


def _verdict(calibration: Calibration) -> str:
    """Return in a sentence which model the data support."""
    if len(calibration.latitudes_deg) == 1:
        return "one latitude fits both models alike: measure at another one to tell them apart"
    if calibration.supported is None:
        return "the data do not tell the two models apart"
    return f"the data support the model '{calibration.supported}'"


def _print(calibration: Calibration, constants: Constants, save: Path | None) -> None:
    drift, ratio, azimuth = calibration.acceleration_sensitive, calibration.ratio, calibration.azimuth
    table = Table("", "", show_header=False, box=SIMPLE)
    table.add_row("gyro", safe(f"{calibration.gyro_model} {calibration.serial_number}"))
    table.add_row("valid", f"{calibration.date} to {calibration.valid_until}")
    if calibration.temperature_min_c is not None:
        table.add_row("temperature", f"{calibration.temperature_min_c:.1f} to {calibration.temperature_max_c:.1f} C")
    table.add_row("scale factor", f"{drift.scale_factor:.5f} ± {drift.scale_factor_sd:.5f}")
    table.add_row(
        "acceleration-sensitive", f"{_with_sd(drift.drift_rate_dph_per_g, drift.drift_rate_sd_dph_per_g)} deg/h/g"
    )
    table.add_row("", _misfit(constants.acceleration_sensitive.chi2, constants.acceleration_sensitive.dof))
    if ratio is not None:
        table.add_row("ratio k", _with_sd(ratio.ratio, ratio.ratio_sd))
        table.add_row("", _misfit(ratio.chi2, ratio.dof))
    table.add_row("model", f"{calibration.model}: {_verdict(calibration)}")
    if azimuth is not None:
        table.add_row("azimuth offset", f"{_with_sd(azimuth.offset_deg, azimuth.offset_sd_deg)} deg")
    if save is not None:
        table.add_row("saved", safe(save))
    Console().print(table)


def _with_sd(value: float, sd: float) -> str:
    return f"{value:.4f} ± {sd:.4f}"


def _misfit(chi2: float, dof: int) -> str:
    return f"chi square {chi2:.1f} of {dof}" if dof else "as many data as constants"
