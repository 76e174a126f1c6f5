"""``northfinder stats``: what a campaign of measurements shows of the instrument."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from northfinder.calibration import read_calibration
from northfinder.campaign import gather, read_member
from northfinder.campaign_report import campaign_json
from northfinder.cli.show import print_json
from northfinder.profile import find_profile
from northfinder.solution import Assumptions

_ROWS = {
    "bias_horizontal_dph": "bias, horizontal plane, deg/h",
    "bias_vertical_dph": "bias, vertical plane, deg/h",
    "scale_factor_horizontal": "scale factor, horizontal plane",
    "scale_factor_vertical": "scale factor, vertical plane",
    "ratio": "ratio k of the scale factors",
    "stated": "latitude as stated, deg",
    "plain": "latitude, nothing corrected, deg",
    "with_ratio": "latitude with k, deg",
}
_JUDGED = {"all": "all together", "within_turn_ons": "within turn-ons", "against_truth": "against the truth"}


@click.command("stats")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RECORD...")
@click.option("--latitude", "latitude_deg", type=click.FloatRange(-90, 90), metavar="DEG", help="The true one.")
@click.option("--azimuth", "azimuth_deg", type=float, metavar="DEG", help="The true one.")
@click.option(
    "--pause", "pause_hours", type=click.FloatRange(min=0, min_open=True), metavar="HOURS",
    help="Compare before and after the first gap this long; if not given, a gap that stands out.",
)  # fmt: skip
@click.option("--profile", metavar="NAME|FILE", help="Gyro profile, instead of that of the records.")
@click.option(
    "--calibration", "calibration_file", type=click.Path(path_type=Path), metavar="FILE",
    help="Constants from northfinder calibrate, instead of those of the records.",
)  # fmt: skip
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.svg", help="Draw all measurements.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(
    *,
    files: Sequence[Path],
    latitude_deg: float | None,
    azimuth_deg: float | None,
    pause_hours: float | None,
    profile: str | None,
    calibration_file: Path | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Compare measurements of one line: scatter within and between turn-ons, before and after a pause.

    Also biases and scale factors of the two planes, latitude with and without correction, and whether the
    measurements scatter as they stated.

    \b
      northfinder stats records/*.sqlite
      northfinder stats records/*.sqlite --latitude 50.429 --pause 100 --plot campaign.svg
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    changes: dict[str, Any] = {} if profile is None else {"profile": find_profile(profile)}
    if calibration_file is not None:
        changes["calibration"] = read_calibration(calibration_file)

    def revise(kept: Assumptions) -> Assumptions:
        return replace(kept, **changes)

    result = campaign_json(
        gather(
            [read_member(path, revise) for path in files],
            pause_hours=pause_hours,
            latitude=None if latitude_deg is None else math.radians(latitude_deg),
            azimuth=None if azimuth_deg is None else math.radians(azimuth_deg),
        )
    )
    if plot is not None:
        from northfinder.cli.plot_campaign import plot_campaign  # noqa: PLC0415  # drawing is dear to import

        plot_campaign(plot, result)
    if as_json:
        print_json(result)
    else:
        print_campaign(result)


def print_campaign(result: dict[str, Any]) -> None:
    """Print the tables of `campaign_json`."""
    console = Console()
    parts = [name for name in ("all", "before", "after") if name in result["azimuth"]]
    table = Table("mean ± sd of one measurement", *parts, box=SIMPLE)
    table.add_row("n", *(str(result["azimuth"][part]["n"]) for part in parts))
    azimuths = [result["azimuth"][part] for part in parts]
    table.add_row("azimuth, deg", *(_pair(each["mean_deg"], each["sd_deg"]) for each in azimuths))
    table.add_row("sd · cos(latitude), deg", *(_number(each["sd_cos_latitude_deg"]) for each in azimuths))
    for name, title in _ROWS.items():
        values = result["planes"].get(name) or result["latitude"].get(name)
        if values is not None:
            lines = [values[part] for part in parts]
            table.add_row(
                title, *(_pair(x.get("mean", x.get("mean_deg")), x.get("sd", x.get("sd_deg"))) for x in lines)
            )
    console.print(table)
    azimuth = result["azimuth"]
    within, between = azimuth["within_turn_on_sd_deg"], azimuth["between_turn_ons_sd_deg"]
    line = f"{result['n_records']} measurements, turn-ons: {result['n_turn_ons']}"
    line += "" if within is None else f"; sd of the azimuth within a turn-on {within:.3f} deg"
    console.print(line + ("" if between is None else f", between turn-ons {between:.3f} deg"))
    if result["pause_h"] is not None:
        console.print(f"pause of {result['pause_h']:.3g} h")
    console.print(_judgements(result["consistency"]))


def _judgements(consistency: dict[str, Any]) -> Table:
    """Return whether the measurements scatter as they stated."""
    table = Table("scatter over stated sd", "", "95 % of honest ones", "chi square", "probability", box=SIMPLE)
    for name, judged in consistency.items():
        for key, each in judged.items():
            table.add_row(
                f"{name}, {_JUDGED[key]}",
                f"{each['rms']:.2f}",
                f"{each['low']:.2f} to {each['high']:.2f}",
                f"{each['chi2']:.1f} of {each['dof']}",
                f"{each['probability']:.2g}",
            )
    return table


def _pair(mean: float | None, sd: float | None) -> str:
    return "" if mean is None else f"{mean:.3f} ± {_number(sd)}"


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.3f}"
