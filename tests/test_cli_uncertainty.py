"""The commands that speak of uncertainty, on records of the emulated bench: budget, calibrate, stats."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from northfinder.cli import cli
from northfinder.errors import NorthFinderError


def northfinder(*arguments: object) -> str:
    """Run a command to its end and return its standard output; its declared failures are raised."""
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    if isinstance(done.exception, NorthFinderError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def as_json(*arguments: object) -> dict[str, Any]:
    """Run a command and return its JSON."""
    found: dict[str, Any] = json.loads(northfinder(*arguments, "--json"))
    return found


def test_budget_tells_ahead_what_find_will_state(tmp_path: Path) -> None:
    """The lines add up to the predicted sd, and declared errors appear with it and enlarge it."""
    bare = as_json("budget", "--plan", "six-position", "--dwell", "60", "--latitude", "50.4", "--azimuth", "147")
    total = math.hypot(*(line["azimuth_deg"] for line in bare["budget"]))
    assert total == pytest.approx(bare["azimuth_sd_deg"], rel=1e-4)
    assert bare["budget"][0]["quantity"] == "bias instability"
    assert bare["azimuth_deg"] == pytest.approx(147.0)
    profile = tmp_path / "mine.toml"
    profile.write_text(
        'name = "mine"\n[noise]\nbias_instability_dph = 0.06\n'
        "[errors]\ntilt_sd_arcsec = 30.0\nstage_angle_sd_arcsec = 900.0\nmisalignment_sd_arcsec = 60.0\n"
    )
    declared = as_json("budget", "--profile", profile, "--plan", "six-position", "--dwell", "60", "--latitude", "50.4")
    lines = {line["quantity"]: line for line in declared["budget"]}
    assert lines["tilt"]["azimuth_deg"] == pytest.approx(30.0 / 3600.0 * math.tan(math.radians(50.4)), rel=0.1)
    assert lines["stage angle"]["sd"] == pytest.approx(900.0)
    assert lines["stage angle"]["azimuth_sensitivity"] * 900.0 == pytest.approx(lines["stage angle"]["azimuth_deg"])
    total = math.hypot(*(line["latitude_deg"] for line in declared["budget"]))
    assert total == pytest.approx(declared["latitude_sd_deg"], rel=1e-4)
    assert "taken as exact" in northfinder("budget", "--time", "120", "--latitude", "50.4", "--latitude-sd", "0")
