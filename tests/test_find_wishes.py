"""What `find` asks of the plan: the command line before the configuration."""

import math
from pathlib import Path

import click
import pytest

from northfinder.adaptive import Wishes
from northfinder.cli import cli, main
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
    ("arguments", "sentence"),
    [
        ("--time 100", "refined does not fit into 100 s: it takes at least 115 s"),
        ("--time 125 --plan six-position", "six-position does not fit into 125 s: it takes at least 126 s"),
        (
            "--gyro native:/dev/null --stage native:/dev/null --profile tvg43 --time 40",
            "takes at least 52 s, more on a slow stage",
        ),
        ("--config slow.toml", "takes at least 81 s, more on a slow stage"),
        ("--gyro nativ:/dev/null --stage native:/dev/null", "no gyro driver 'nativ' in 'nativ:/dev/null'"),
        ("--gyro native:/dev/null --stage native", "'native' names no stage"),
        ("--config mistyped.toml", "no stage driver 'zabr'"),
        ("--config option.toml", "the driver 'native' takes no option 'colour'"),
    ],
)
def test_what_cannot_be_is_refused_before_a_record_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: str, sentence: str
) -> None:
    """A time too short for any such stage, with the shortest that does, or a driver that there is not: exit code 2."""
    monkeypatch.chdir(tmp_path)
    bench = '[gyro]\naddress = "native:/dev/null"\nprofile = "tvg43"\n[stage]\naddress = "{}:/dev/null"\n'
    Path("mistyped.toml").write_text(bench.format("zabr"))
    Path("slow.toml").write_text(bench.format("native") + "max_speed_deg_s = 20.0\n[measurement]\ntime_s = 60.0\n")
    Path("option.toml").write_text(bench.format("native") + '[stage.options]\ncolour = "red"\n')
    with pytest.raises(SystemExit) as left:
        main(["find", *arguments.split(), "--out", "records"])
    err = capsys.readouterr().err
    assert (left.value.code, len(err.splitlines())) == (2, 1)
    assert sentence in err
    assert not Path("records").exists()


@pytest.mark.parametrize(
    "arguments",
    ["find --time nan", "find --until-sd inf", "plan --azimuth nan", "plan --stage-speed inf", "budget --latitude nan",
     "calibrate --latitude nan x.sqlite"],
)  # fmt: skip
def test_numbers_that_are_none_are_refused(arguments: str) -> None:
    """NaN is within no range, and an infinite speed is none; click takes both."""
    with pytest.raises(click.BadParameter, match="expected a finite number"):
        cli.main(arguments.split(), standalone_mode=False)
