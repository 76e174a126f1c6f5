"""Plans as data: the built-in ones, files, and what is said of bad ones."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.api import StageLimits
from northfinder.cyclogram import Step, find_cyclogram, reachable_azimuth, six_position
from northfinder.errors import ConfigError

LIMITS = StageLimits(
    azimuth_min=math.radians(-200),
    azimuth_max=math.radians(200),
    elevation_min=math.radians(-95),
    elevation_max=math.radians(95),
    max_speed=0.2,
)


def test_six_position_is_the_published_cyclogram() -> None:
    """Eight dwells of two minutes in the order of formula (1)."""
    plan = six_position()
    assert [step.name for step in plan.steps] == ["U1", "U2", "U3", "U4", "U1", "U5", "U6", "U1"]
    assert plan.duration == 960.0
    assert [round(math.degrees(step.azimuth)) for step in plan.steps] == [0, 90, 180, 270, 0, 0, 0, 0]
    assert [round(math.degrees(step.elevation)) for step in plan.steps] == [0, 0, 0, 0, 0, 90, -90, 0]


def test_a_plan_from_a_file(tmp_path: Path) -> None:
    """Steps come in the file's order, with its angles and dwells."""
    file = tmp_path / "pair.toml"
    file.write_text(
        'name = "pair"\n'
        "[[step]]\nname = 'east'\nazimuth_deg = 90.0\nelevation_deg = 0\ndwell_s = 30\n"
        "[[step]]\nname = 'west'\nazimuth_deg = 270.0\nelevation_deg = 0\ndwell_s = 31.5\n"
    )
    plan = find_cyclogram(str(file))
    assert plan.name == "pair"
    assert plan.steps[1] == Step(name="west", azimuth=math.radians(270), elevation=0.0, dwell=31.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 'x'\nstep = []", "has no steps"),
        ("name = 'x'\n[[step]]\nname='U1'\nazimuth_deg='north'\nelevation_deg=0\ndwell_s=1", "azimuth_deg"),
        ("name = 'x'\n[[step]]\nname='U1'\nazimuth_deg=0\nelevation_deg=95\ndwell_s=1", "elevation must lie within"),
        ("name = 'x'\n[[step]]\nname='U1'\nazimuth_deg=0\nelevation_deg=0\ndwell_s=-1", "dwell must be a positive"),
        ("name = 'x'\n[[step]]\nname='U1'\nazimuth_deg=nan\nelevation_deg=0\ndwell_s=1", "finite angle"),
        ("name = 'x'\nspeed = 3\nstep = []", "unknown field `speed`"),
        ("name = ", "not valid TOML"),
        ("\ufffe\x00", "not valid TOML"),
    ],
)
def test_a_bad_plan_is_named_in_one_sentence(tmp_path: Path, text: str, message: str) -> None:
    """The sentence names the file, and what was wrong in it."""
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        find_cyclogram(str(file))
    assert "bad.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_plan_names_the_known_ones() -> None:
    """A misspelt name says what would have been right."""
    with pytest.raises(ConfigError, match="'six-positions': expected six-position, four-position"):
        find_cyclogram("six-positions")


@given(
    target=st.floats(-20.0, 20.0),
    present=st.floats(-3.4, 3.4),
    lowest=st.floats(-7.0, -3.2),
    highest=st.floats(3.2, 7.0),
)
def test_a_reachable_azimuth_is_equivalent_near_and_allowed(
    target: float, present: float, lowest: float, highest: float
) -> None:
    """It points the same way, lies within the limits, and no allowed turn would be shorter."""
    azimuth = reachable_azimuth(target, present, lowest, highest)
    turns = (azimuth - target) / (2 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert lowest - 1e-6 <= azimuth <= highest + 1e-6
    for other in (azimuth - 2 * math.pi, azimuth + 2 * math.pi):
        if lowest <= other <= highest:
            assert abs(azimuth - present) <= abs(other - present) + 1e-9


def test_a_plan_beyond_the_stage_is_refused_before_it_starts() -> None:
    """A stage that turns by less than a circle cannot take all azimuths, one that cannot look up not all elevations."""
    narrow = StageLimits(
        azimuth_min=0.0, azimuth_max=math.radians(200), elevation_min=-0.1, elevation_max=0.1, max_speed=1.0
    )
    with pytest.raises(ConfigError, match="azimuth 270 deg cannot be reached: the stage turns from 0 to 200 deg"):
        six_position().check(narrow)
    flat = StageLimits(azimuth_min=-7.0, azimuth_max=7.0, elevation_min=-0.1, elevation_max=0.1, max_speed=1.0)
    with pytest.raises(ConfigError, match="step U5 at elevation 90 deg cannot be reached"):
        six_position().check(flat)
    six_position().check(LIMITS)
