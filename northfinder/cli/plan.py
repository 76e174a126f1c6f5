"""``northfinder plan``: which plan gives what in a given time, before anything is measured."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table

from northfinder.cli.show import print_json, safe
from northfinder.errors import ConfigError
from northfinder.estimation.planning import Truth
from northfinder.plan_report import best_of_each, candidate_json, curve_json, survey
from northfinder.plans import Conditions
from northfinder.solution import Assumptions
from northfinder.text import printable
from northfinder.turns import BLOCK_PAUSE, Turns

_POSITIVE = click.FloatRange(min=0.0, min_open=True)


@click.command("plan")
@click.option("--profile", default="tvg43", show_default=True, metavar="NAME|FILE", help="Gyro profile: its noise.")
@click.option(
    "--time", "time_s", type=click.FloatRange(min=10.0, max=3600.0), default=300.0, show_default=True, metavar="S",
    help="From the first slew to the end.",
)  # fmt: skip
@click.option("--latitude", "latitude_deg", type=click.FloatRange(-90, 90), metavar="DEG", help="Latitude, if known.")
@click.option("--need-latitude", is_flag=True, help="The latitude is to be measured as well.")
@click.option("--azimuth", "azimuth_deg", type=float, metavar="DEG", help="Azimuth of stage zero, if roughly known.")
@click.option("--turn-time", type=click.FloatRange(min=0.0), metavar="S", help="From dwell to dwell, for every turn.")
@click.option("--stage-speed", type=_POSITIVE, default=11.25, show_default=True, metavar="DEG/S")
@click.option("--stage-acceleration", type=_POSITIVE, default=5.625, show_default=True, metavar="DEG/S2")
@click.option("--settle", type=click.FloatRange(min=0.0), default=0.5, show_default=True, metavar="S")
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.svg", help="Draw predicted sd against time.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(
    *,
    profile: str,
    time_s: float,
    latitude_deg: float | None,
    need_latitude: bool,
    azimuth_deg: float | None,
    turn_time: float | None,
    stage_speed: float,
    stage_acceleration: float,
    settle: float,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Search orders and dwells of the built-in plans, and predict the standard deviations of azimuth and latitude.

    The figures are those that find will state where the noise fits the profile.

    \b
      northfinder plan --time 300 --latitude 50.4
      northfinder plan --time 960 --need-latitude --turn-time 8 --plot plans.svg
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    if need_latitude and latitude_deg is not None:
        raise ConfigError("--latitude and --need-latitude exclude each other: it is either known or to be measured")
    turns = Turns(
        speed=math.radians(stage_speed), acceleration=math.radians(stage_acceleration), pause=settle + BLOCK_PAUSE
    )
    conditions = _conditions(
        profile,
        turns=turns if turn_time is None else Turns(constant=turn_time),
        time=time_s,
        latitude_deg=latitude_deg,
        need_latitude=need_latitude,
        azimuth_deg=azimuth_deg,
    )
    found, refused = survey(conditions, azimuth_known=azimuth_deg is not None)
    listed = [candidate_json(each, conditions) for each in found]
    result: dict[str, Any] = {
        "profile": profile,
        "time_s": time_s,
        "truth_latitude_deg": math.degrees(conditions.truth.latitude),
        "truth_azimuth_deg": math.degrees(conditions.truth.azimuth),
        "best": listed[0],
        "candidates": listed,
        "refused": refused,
    }
    if plot is not None:
        from northfinder.cli.plot_plan import plot_plans  # noqa: PLC0415  # drawing is dear to import

        curves = {each.cyclogram.name: curve_json(each, conditions) for each in best_of_each(found)}
        result["curves"] = curves
        plot_plans(plot, f"{printable(profile)}: azimuth sd x cos(latitude), dashed latitude sd", curves)
    if as_json:
        print_json(result)
    else:
        _print(result)


def _conditions(
    profile: str,
    *,
    turns: Turns,
    time: float,
    latitude_deg: float | None,
    need_latitude: bool,
    azimuth_deg: float | None,
) -> Conditions:
    """Return what the plans are searched for. Raises ConfigError."""
    assumptions = Assumptions.gather(method="generalised", profile=profile, latitude_deg=latitude_deg, g_drift_dph=None)
    noise = assumptions.noise()
    if noise is None or noise == replace(noise, **dict.fromkeys(noise.__slots__, 0.0)):
        raise ConfigError(f"the profile {profile} has no noise: there is nothing to plan by")
    truth = Truth()
    if latitude_deg is not None:
        truth = replace(truth, latitude=math.radians(latitude_deg))
    if azimuth_deg is not None:
        truth = replace(truth, azimuth=math.radians(azimuth_deg))
    return Conditions(
        noise=noise, known=assumptions.known(), turns=turns, time=time, needs_latitude=need_latitude, truth=truth
    )


def _print(result: dict[str, Any]) -> None:
    table = Table(
        Column("plan", no_wrap=True),
        Column("order", no_wrap=True),
        Column("n", justify="right", no_wrap=True),
        Column("s each", justify="right", no_wrap=True),
        Column("azimuth", justify="right", no_wrap=True),
        Column("latitude", justify="right", no_wrap=True),
        title=f"{result['time_s']:g} s with {printable(result['profile'])}",
        caption="n dwells; predicted sd in deg; of the azimuth times cos(latitude)",
        box=SIMPLE,
    )
    for each in result["candidates"]:
        latitude_sd = each["latitude_sd_deg"]
        table.add_row(
            each["plan"],
            each["order"],
            str(each["n_dwells"]),
            f"{each['shortest_dwell_s']:.0f} to {each['longest_dwell_s']:.0f}",
            f"{each['azimuth_sd_cos_latitude_deg']:.4f}",
            "" if latitude_sd is None else f"{latitude_sd:.4f}",
        )
    console = Console()
    console.print(table)
    best = result["best"]
    sd, latitude = best["azimuth_sd_deg"], result["truth_latitude_deg"]
    console.print(f"best: {best['plan']}, azimuth sd {sd:.4f} deg at latitude {latitude:g} deg")
    for name, reason in result["refused"].items():
        console.print(f"{name}: {safe(reason)}")
