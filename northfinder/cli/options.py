"""Options that several commands share, and what is made of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

Command = Callable[..., Any]

#: A file that the command itself reads: whether it can, its reader says, with the exit code that goes with it.
FILE = click.Path(path_type=Path, readable=False)
#: Values of --method.
METHODS = ("generalised", "ordinary")


def position_options(command: Command) -> Command:
    """Add the options that say where the instrument stands, for grid azimuth and magnetic bearing."""
    options = [
        click.option(
            "--position",
            metavar="LAT,LON[,HEIGHT]",
            help="Of the instrument, in deg and m: adds grid azimuth and magnetic bearing.",
        ),
        click.option(
            "--epsg",
            type=click.IntRange(min=1),
            metavar="CODE",
            help="The grid, a projected coordinate reference system; if not given, the UTM zone.",
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def estimation_options(command: Command) -> Command:
    """Add the options that say how to estimate and what is known beforehand."""
    options = [
        click.option(
            "--latitude",
            "latitude_deg",
            type=click.FloatRange(-90, 90),
            metavar="DEG",
            help="Latitude, if known; else it is measured where the plan allows.",
        ),
        click.option(
            "--latitude-sd",
            "latitude_sd_deg",
            type=click.FloatRange(min=0),
            default=0.0,
            metavar="DEG",
            help="Standard deviation of the latitude given.",
        ),
        click.option(
            "--calibration",
            "calibration_file",
            type=click.Path(path_type=Path),
            metavar="FILE",
            help="Constants from northfinder calibrate, instead of the profile's.",
        ),
        click.option("--profile", metavar="NAME|FILE", help="Gyro profile: noise and constants."),
        click.option(
            "--g-drift",
            "g_drift_dph",
            type=float,
            metavar="DPH",
            help="Acceleration-sensitive drift rate in deg/h per g, instead of the profile's.",
        ),
        click.option(
            "--method",
            type=click.Choice(METHODS),
            default="generalised",
            show_default=True,
            help="Weights of the least squares.",
        ),
        click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output."),
    ]
    for option in reversed(options):
        command = option(command)
    return command
