"""``northfinder budget``: the uncertainty of a fix, part by part, before anything is measured."""

from __future__ import annotations

import math
from pathlib import Path

import click
from rich.console import Console

from northfinder.adaptive import Wishes, make_plan
from northfinder.budget_report import budget_table
from northfinder.calibration import read_calibration
from northfinder.cli.show import print_json, safe
from northfinder.errors import ConfigError
from northfinder.estimation.planning import Truth, planned_means
from northfinder.plans import timetable
from northfinder.solution import Assumptions, fix_to_json, solve, supplement
from northfinder.turns import BLOCK_PAUSE, Turns

_POSITIVE = click.FloatRange(min=0.0, min_open=True)
_KEYS = ("azimuth_deg", "azimuth_sd_deg", "latitude_deg", "latitude_sd_deg", "latitude_reason")


@click.command("budget")
@click.option("--profile", default="tvg43", show_default=True, metavar="NAME|FILE", help="Gyro profile.")
@click.option("--plan", metavar="NAME|FILE", help="As for find.")
@click.option("--time", "time_s", type=click.FloatRange(min=10.0), metavar="S", help="From the first slew to the end.")
@click.option("--dwell", "dwell_s", type=click.FloatRange(min=1), metavar="S", help="Dwell of six or four positions.")
@click.option(
    "--latitude", "latitude_deg", type=click.FloatRange(-90, 90), default=45.0, show_default=True, metavar="DEG",
    help="Where it will be measured.",
)  # fmt: skip
@click.option(
    "--latitude-sd", "latitude_sd_deg", type=click.FloatRange(min=0), metavar="DEG",
    help="How well that is known beforehand, 0 for exactly; if not given, it is to be measured.",
)  # fmt: skip
@click.option("--azimuth", "azimuth_deg", type=float, default=33.0, show_default=True, metavar="DEG")
@click.option(
    "--calibration", "calibration_file", type=click.Path(path_type=Path), metavar="FILE",
    help="Constants from northfinder calibrate.",
)  # fmt: skip
@click.option("--turn-time", type=click.FloatRange(min=0.0), metavar="S", help="From dwell to dwell, for every turn.")
@click.option("--stage-speed", type=_POSITIVE, default=11.25, show_default=True, metavar="DEG/S")
@click.option("--stage-acceleration", type=_POSITIVE, default=5.625, show_default=True, metavar="DEG/S2")
@click.option("--settle", type=click.FloatRange(min=0.0), default=0.5, show_default=True, metavar="S")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(
    *,
    profile: str,
    plan: str | None,
    time_s: float | None,
    dwell_s: float | None,
    latitude_deg: float,
    latitude_sd_deg: float | None,
    azimuth_deg: float,
    calibration_file: Path | None,
    turn_time: float | None,
    stage_speed: float,
    stage_acceleration: float,
    settle: float,
    as_json: bool,
) -> None:
    """List what will contribute to the uncertainty of azimuth and latitude, the largest first.

    \b
      northfinder budget --plan six-position --latitude 50.4
      northfinder budget --time 300 --latitude 50.4 --latitude-sd 0 --profile mine.toml
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    assumptions = Assumptions.gather(
        method="generalised",
        profile=profile,
        latitude_deg=None if latitude_sd_deg is None else latitude_deg,
        latitude_sd_deg=latitude_sd_deg or 0.0,
        g_drift_dph=None,
        calibration=None if calibration_file is None else read_calibration(calibration_file),
    )
    turns = Turns(
        speed=math.radians(stage_speed), acceleration=math.radians(stage_acceleration), pause=settle + BLOCK_PAUSE
    )
    turns = turns if turn_time is None else Turns(constant=turn_time)
    truth = Truth(azimuth=math.radians(azimuth_deg), latitude=math.radians(latitude_deg))
    noise = assumptions.noise()
    if noise is None or not any(getattr(noise, name) for name in noise.__slots__):
        raise ConfigError(f"the profile {profile} has no noise: there is nothing to predict by")
    wishes = Wishes(name=plan, dwell=dwell_s, time=time_s, azimuth=truth.azimuth)
    course = make_plan(wishes, assumptions, settle=settle)
    dwells = timetable(course.design(turns).cyclogram, turns, truth.azimuth)
    means = planned_means(dwells, truth, known=assumptions.known())
    fix = solve(means, assumptions)
    result = {name: value for name, value in fix_to_json(fix).items() if name in _KEYS}
    result |= {"profile": profile, "plan": course.name, "duration_s": dwells[-1].start + dwells[-1].duration}
    result |= supplement(means, assumptions, fix)
    if as_json:
        print_json(result)
        return
    title = f"{safe(course.name)}, {result['duration_s']:.0f} s, with {safe(profile)} at {latitude_deg:g} deg"
    Console().print(budget_table(result["budget"], title=title))
    if result["latitude_deg"] is None:
        Console().print(f"latitude: {safe(result['latitude_reason'])}")
    for note in result["notes"]:
        Console().print(f"note: {safe(note)}")
