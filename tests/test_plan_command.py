"""`northfinder plan`: what it predicts, prints and draws, and what it refuses."""

import json
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner, Result

from northfinder.cli.plan import command
from northfinder.cyclogram import Cyclogram
from northfinder.errors import ConfigError
from northfinder.layouts import families
from northfinder.plan_report import order


def plan(*options: str) -> Result:
    """Run the command; declared failures are raised."""
    return CliRunner().invoke(command, options, catch_exceptions=False)


def planned(*options: str) -> dict[str, Any]:
    """Return what the command prints as JSON."""
    result: dict[str, Any] = json.loads(plan("--json", *options).stdout)
    return result


def test_the_best_comes_first_and_refined_leads() -> None:
    """At a known latitude refined is the best that knows no azimuth, and keeps its figure; six positions come last."""
    result = planned("--time", "300", "--latitude", "50.429", "--turn-time", "8")
    sds = [each["azimuth_sd_cos_latitude_deg"] for each in result["candidates"]]
    assert sds == sorted(sds)
    assert result["best"]["plan"] == "refined"
    assert result["best"]["azimuth_sd_cos_latitude_deg"] <= 0.091
    assert result["best"]["azimuth_sd_deg"] == pytest.approx(sds[0] / math.cos(math.radians(50.429)))
    assert result["candidates"][-1]["plan"] == "six-position"
    assert all(each["duration_s"] == pytest.approx(300) for each in result["candidates"])
    assert list(result["refused"]) == ["double"]


def test_a_needed_latitude_leaves_the_plans_that_measure_it() -> None:
    """Every candidate predicts the latitude; the others are named with the reason."""
    result = planned("--time", "300", "--need-latitude")
    assert {each["plan"] for each in result["candidates"]} == {"refined", "six-position"}
    assert all(each["latitude_sd_deg"] > 0 for each in result["candidates"])
    assert result["refused"]["four-position"] == "does not measure the latitude"


def test_turn_time_and_stage_matter() -> None:
    """Faster turns leave more time to measure: constant ones, or those of a quicker stage."""
    slow, quick, quicker = (
        planned("--time", "180", "--latitude", "45", *options)["best"]["azimuth_sd_deg"]
        for options in ((), ("--stage-speed", "45", "--stage-acceleration", "45"), ("--turn-time", "1"))
    )
    assert slow > 1.05 * quick > quicker


def test_a_known_azimuth_admits_double(tmp_path: Path) -> None:
    """It then is the best of all in a short time, and the plot shows every plan's curve."""
    file = tmp_path / "plans.svg"
    result = planned("--time", "180", "--latitude", "45", "--azimuth", "30", "--plot", str(file))
    assert result["best"]["plan"] == "double"
    assert set(result["curves"]) == {each["plan"] for each in result["candidates"]}
    for name, curve in result["curves"].items():
        times = [point["time_s"] for point in curve]
        assert times == sorted(times)
        final = next(each for each in result["candidates"] if each["plan"] == name)
        assert curve[-1]["azimuth_sd_deg"] == pytest.approx(final["azimuth_sd_deg"])
        assert curve[0]["azimuth_sd_deg"] > curve[-1]["azimuth_sd_deg"]
    assert ET.parse(file).getroot().tag.endswith("svg")  # noqa: S314  # written by ourselves a moment ago


def test_the_table_is_readable() -> None:
    """Plan, order and figures stand in 80 columns, and what is left out with its reason."""
    text = plan("--time", "300").stdout
    assert "123 (EW) x 2.5" in text
    assert "best: refined" in text
    assert "double: starts from a roughly known azimuth" in text
    assert max(len(line) for line in text.splitlines()) <= 80


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--time", "20"), "no plan gives what is wanted in 20 s"),
        (("--latitude", "50", "--need-latitude"), "exclude each other"),
        (("--profile", "tvg44"), "no gyro profile 'tvg44'"),
    ],
)
def test_refusals(options: tuple[str, ...], message: str) -> None:
    """One sentence says what was wrong."""
    with pytest.raises(ConfigError, match=message):
        plan(*options)


def test_a_profile_without_noise_is_refused(tmp_path: Path) -> None:
    """Without noise every plan is as good as any other."""
    file = tmp_path / "silent.toml"
    file.write_text('name = "silent"\n[noise]\n')
    with pytest.raises(ConfigError, match="has no noise"):
        plan("--profile", str(file))


@pytest.mark.parametrize(
    ("name", "n", "text"),
    [("six-position", 1, "12341561"), ("six-position", 2, "(1234156) x 2.14"), ("refined", 5, "123 (EW) x 2.5")],
)
def test_orders_in_short(name: str, n: int, text: str) -> None:
    """Brackets say what is gone through twice or more; successive visits of a position are one dwell."""
    layout = families(name, needs_latitude=False)[0](n)
    assert layout is not None
    assert order(Cyclogram(name=name, steps=layout.opening + layout.pattern)) == text
