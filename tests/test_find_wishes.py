"""What `find` asks of the plan: the command line before the configuration."""

import math

from northfinder.adaptive import Wishes
from northfinder.cli.find import Options, command
from northfinder.config import MeasurementTable

TABLE = MeasurementTable(plan="double", time_s=180.0, until_sd_deg=0.2, azimuth_deg=30.0)


def wishes(table: MeasurementTable, *arguments: str) -> Wishes:
    """Return what ``find`` with these arguments wishes beside this configuration."""
    with command.make_context("find", list(arguments)) as context:
        return Options(**context.params).wishes(table)


def test_the_configuration_holds_where_the_command_line_is_silent() -> None:
    """Every wish of the file reaches the plan, angles in rad."""
    assert wishes(TABLE) == Wishes(name="double", time=180.0, until_sd=math.radians(0.2), azimuth=math.radians(30.0))
    assert wishes(MeasurementTable()) == Wishes()


def test_the_command_line_comes_first() -> None:
    """A dwell asked for puts the file's time aside, as they exclude each other; and a time the file's dwell."""
    asked = wishes(TABLE, "--plan", "six-position", "--dwell", "20", "--until-sd", "0.1")
    assert asked == Wishes(name="six-position", dwell=20.0, until_sd=math.radians(0.1), azimuth=math.radians(30.0))
    assert wishes(MeasurementTable(dwell_s=20.0), "--time", "300") == Wishes(time=300.0)
