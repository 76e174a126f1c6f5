"""What `find` asks of the plan: the command line before the configuration."""

import math

import click
import pytest

from northfinder.adaptive import Wishes
from northfinder.cli import cli
from northfinder.cli.find import Options, command
from northfinder.config import MeasurementTable
from northfinder.errors import ConfigError

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


def test_a_plan_of_the_command_line_that_is_a_file_keeps_its_dwells() -> None:
    """The file's time belongs to the file's plan: four hours at rest are not pressed into three minutes."""
    assert wishes(TABLE, "--plan", "rest.toml").time is None
    assert wishes(TABLE, "--plan", "rest.toml", "--time", "900").time == 900.0
    assert wishes(TABLE, "--plan", "double").time == 180.0


@pytest.mark.parametrize(
    "option", [["--speed", "1"], ["--sim-azimuth", "33"], ["--sim-gyro", "native"], ["--seed", "1"], ["--bus", "slcan"]]
)
def test_what_is_of_the_emulator_is_refused_beside_devices(option: list[str]) -> None:
    """Even at its default's value; where it is not given devices may be named."""
    devices = ["--gyro", "native:a", "--stage", "native:b"]
    with command.make_context("find", [*devices, *option]) as context, pytest.raises(ConfigError, match=option[0]):
        Options(**context.params).bench()
    with command.make_context("find", devices) as context:
        assert Options(**context.params).bench() is not None


@pytest.mark.parametrize(
    "arguments",
    ["find --time nan", "find --until-sd inf", "plan --azimuth nan", "plan --stage-speed inf", "budget --latitude nan",
     "calibrate --latitude nan x.sqlite"],
)  # fmt: skip
def test_numbers_that_are_none_are_refused(arguments: str) -> None:
    """NaN is within no range, and an infinite speed is none; click takes both."""
    with pytest.raises(click.BadParameter, match="expected a finite number"):
        cli.main(arguments.split(), standalone_mode=False)
