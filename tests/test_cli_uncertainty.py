"""The commands that speak of uncertainty, on records of the emulated bench: budget, calibrate, stats."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from virtual import virtual_bench

from drivers.errors import DeviceFaultError
from northfinder.calibration import read_calibration
from northfinder.cli import cli, exit_code
from northfinder.cyclogram import four_position, six_position
from northfinder.errors import ConfigError, EstimateError, NorthFinderError, RecordError
from northfinder.record import Record


def northfinder(*arguments: object) -> str:
    """Run a command to its end and return its standard output; its declared failures are raised."""
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    if isinstance(done.exception, NorthFinderError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def shown(*arguments: object) -> str:
    """Run a command and return what people see, without borders and line breaks."""
    return " ".join(northfinder(*arguments).replace("│", " ").split())


def as_json(*arguments: object) -> dict[str, Any]:
    """Run a command and return its JSON."""
    found: dict[str, Any] = json.loads(northfinder(*arguments, "--json"))
    return found


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return records of one gyro: three at latitude 50.429 in two turn-ons, one at latitude 30."""
    folder = tmp_path_factory.mktemp("records")
    home, abroad = virtual_bench(seed=12), virtual_bench(seed=12, latitude_deg=30.0)
    paths = [folder / f"{number}.sqlite" for number in range(4)]
    for path in paths[:2]:
        home.measure(path, six_position(20.0))
    for bench in (home, abroad, abroad):  # so that each record has noise of its own
        bench.bench.reset("gyro")
    home.measure(paths[2], six_position(20.0))
    abroad.measure(paths[3], six_position(20.0))
    return paths


@pytest.fixture
def calibration(records: list[Path], tmp_path: Path) -> Path:
    """Return the calibration from the records at 50.429, whose line lies 3 deg before stage azimuth zero."""
    path = tmp_path / "gyro.toml"
    northfinder("calibrate", *records[:3], "--latitude", 50.429, "--azimuth", 30.0, "--save", path)
    return path


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


def test_calibrate_finds_the_constants_and_says_what_it_rests_on(records: list[Path], calibration: Path) -> None:
    """Each constant within four of its standard deviations; whose gyro, since when, until when, how warm."""
    found = read_calibration(calibration)
    drift = found.acceleration_sensitive
    assert abs(drift.drift_rate_dph_per_g - 3.0) < 4.0 * drift.drift_rate_sd_dph_per_g < 1.0
    assert abs(drift.scale_factor - 1.021) < 4.0 * drift.scale_factor_sd < 0.1
    assert found.ratio is not None
    assert abs(found.ratio.ratio - 0.797) < 4.0 * found.ratio.ratio_sd
    assert found.azimuth is not None
    assert abs(found.azimuth.offset_deg - 3.0) < 4.0 * found.azimuth.offset_sd_deg
    assert (found.serial_number, found.n_records, found.supported) == ("SIM-G12", 3, None)
    assert str(found.date) == "1970-01-01"  # the virtual clock starts there
    assert str(found.valid_until) == "1971-01-01"
    assert found.temperature_min_c == pytest.approx(24.0, abs=0.1)
    everywhere = as_json("calibrate", *records, *["--latitude", 50.429] * 3, "--latitude", 30.0)
    assert everywhere["supported"] == "acceleration-sensitive"
    assert "support" in everywhere["verdict"]
    table = shown("calibrate", *records[:3], "--latitude", 50.429)
    assert "measure at another one to tell them apart" in table


def test_a_calibration_is_applied_and_reported(records: list[Path], calibration: Path, tmp_path: Path) -> None:
    """Elsewhere the drift rate is right within the statement and the ratio 2.6 deg wrong; azimuths move."""
    plain = as_json("solve", records[3])
    right = as_json("solve", records[3], "--calibration", calibration)
    assert abs(right["latitude_deg"] - 30.0) < 4.0 * right["latitude_sd_deg"] < 2.0
    offset = right["calibration"]["azimuth_offset_deg"]
    assert math.remainder(right["azimuth_deg"] - plain["azimuth_deg"] + offset, 360.0) == pytest.approx(0.0, abs=0.05)
    lines = {line["quantity"]: line for line in right["budget"]}
    assert lines["azimuth offset"]["azimuth_deg"] == pytest.approx(read_calibration(calibration).azimuth.offset_sd_deg)  # type: ignore[union-attr]
    for name in ("azimuth", "latitude"):
        total = math.hypot(*(line[f"{name}_deg"] for line in right["budget"]))
        assert total == pytest.approx(right[f"{name}_sd_deg"], rel=1e-4)
    ratio = tmp_path / "ratio.toml"
    northfinder("calibrate", *records[:3], "--latitude", 50.429, "--model", "ratio", "--save", ratio)
    wrong = as_json("solve", records[3], "--calibration", ratio)
    assert wrong["calibration"]["model"] == "ratio"
    assert wrong["latitude_deg"] - right["latitude_deg"] == pytest.approx(2.6, abs=0.3)
    total = math.hypot(*(line["latitude_deg"] for line in wrong["budget"]))
    assert total == pytest.approx(wrong["latitude_sd_deg"], rel=1e-4)


def test_a_calibration_of_another_gyro_or_time_is_refused(
    records: list[Path], calibration: Path, tmp_path: Path
) -> None:
    """One clear sentence with both serial numbers, or with date and validity; find refuses before anything moves."""
    text = calibration.read_text()
    other, later = tmp_path / "other.toml", tmp_path / "later.toml"
    other.write_text(text.replace("SIM-G12", "SIM-G13"))
    later.write_text(text.replace("date = 1970-01-01", "date = 1970-06-01"))
    with pytest.raises(ConfigError, match="'SIM-G13', and this one has 'SIM-G12'"):
        northfinder("solve", records[3], "--calibration", other)
    with pytest.raises(ConfigError, match="valid from 1970-06-01 to 1971-01-01, not on 1970-01-01"):
        northfinder("solve", records[3], "--calibration", later)
    with pytest.raises(ConfigError, match="is valid from 1970-01-01 to 1971-01-01, not on 20"):
        northfinder("find", "--speed", "max", "--calibration", calibration, "--out", tmp_path)
    with pytest.raises(RecordError, match="never overwritten"):
        northfinder("calibrate", *records[:3], "--latitude", 50.429, "--save", calibration)
    later.write_text(text.replace('model = "acc', 'modell = "acc'))
    with pytest.raises(ConfigError, match="modell"):
        northfinder("solve", records[3], "--calibration", later)


def test_a_calibration_needs_one_gyro_and_known_places(records: list[Path], tmp_path: Path) -> None:
    """Records of two gyros, a missing latitude and too many of them are the operator's mistakes, each named."""
    stranger = tmp_path / "stranger.sqlite"
    virtual_bench(seed=13).measure(stranger, six_position(5.0))
    with pytest.raises(ConfigError, match=r"'SIM-G12', .* of 'SIM-G13'"):
        northfinder("calibrate", records[0], stranger, "--latitude", 50.429)
    with pytest.raises(ConfigError, match="give --latitude"):
        northfinder("calibrate", records[0])
    with pytest.raises(ConfigError, match="given 2 times for 3 records"):
        northfinder("calibrate", *records[:3], "--latitude", 1, "--latitude", 2)


def test_a_wrong_latitude_without_a_vertical_plane_is_caught(tmp_path: Path) -> None:
    """Four positions and a gyro whose scale factor is known: 10 deg off is no trustworthy estimate, exit code 4."""
    record, profile = tmp_path / "four.sqlite", tmp_path / "mine.toml"
    virtual_bench(seed=22).measure(record, four_position(20.0), latitude_deg=50.429)
    profile.write_text(
        'name = "mine"\nscale_factor = 1.021\nscale_factor_sd = 0.002\n'
        "[noise]\nangle_white_noise_dph_s = 0.764\nbias_instability_dph = 0.06\n"
        "angle_random_walk_deg_per_sqrt_h = 0.003\nrate_random_walk_dph_per_sqrt_h = 0.2\n"
    )
    right = as_json("solve", record, "--profile", profile)
    assert {check["name"]: check["unit"] for check in right["checks"]}["earth rate"] == "deg/h"
    assert right["trustworthy"]
    with pytest.raises(EstimateError, match="no trustworthy estimate: the measured earth rate does not agree") as wrong:
        northfinder("solve", record, "--profile", profile, "--latitude", 60.429)
    assert exit_code(wrong.value) == 4


def test_a_drift_rate_that_nobody_knows_is_said(records: list[Path], calibration: Path, tmp_path: Path) -> None:
    """The shift of the latitude in the note is what 1 deg/h per g does; told in any way, 0 too, there is no note."""
    mine, zero = tmp_path / "mine.toml", tmp_path / "zero.toml"
    noise = "[noise]\nangle_white_noise_dph_s = 0.764\nbias_instability_dph = 0.06\n"
    mine.write_text(f'name = "mine"\n{noise}')
    zero.write_text(f'name = "zero"\nacceleration_sensitive_drift_rate_dph_per_g = 0.0\n{noise}')
    unknown = as_json("solve", records[0], "--profile", mine)
    (note,) = unknown["notes"]
    assert note.startswith("the acceleration-sensitive drift rate is not known and taken as zero: each deg/h per g")
    shift = float(note.split()[-2])
    moved = as_json("solve", records[0], "--profile", mine, "--g-drift", 1.0)
    assert unknown["latitude_deg"] - moved["latitude_deg"] == pytest.approx(shift, rel=0.1)
    assert moved["notes"] == []
    assert as_json("solve", records[0], "--profile", zero)["latitude_deg"] == unknown["latitude_deg"]
    for told in (("--profile", zero), ("--profile", mine, "--calibration", calibration), ("--profile", "tvg43")):
        assert as_json("solve", records[0], *told)["notes"] == []
    entered = as_json("solve", records[0], "--profile", mine, "--latitude", 50.429, "--latitude-sd", 20.0)
    assert entered["notes"] == []
    assert "note the acceleration-sensitive drift rate is not known" in shown("solve", records[0], "--profile", mine)
    assert "not known and taken as zero" in shown("budget", "--profile", mine, "--time", 120, "--latitude", 50)


def test_a_latitude_given_exactly_is_shown_as_given(records: list[Path]) -> None:
    """No plus-minus of zero; one given within a standard deviation keeps it."""
    assert "latitude 50.429 deg, as given" in shown("solve", records[0], "--latitude", 50.429)
    assert "as given" not in shown("solve", records[0], "--latitude", 50.429, "--latitude-sd", 0.1)


def test_residuals_larger_than_usual_are_said_in_those_words(records: list[Path], tmp_path: Path) -> None:
    """By how much the plus-minus are widened, after a profile that promises far too little noise."""
    calm = tmp_path / "calm.toml"
    calm.write_text('name = "calm"\n[noise]\nangle_white_noise_dph_s = 0.1\n')
    factor = as_json("solve", records[0], "--profile", calm)["rescaled_by"]
    assert factor > 2.0
    panel = shown("solve", records[0], "--profile", calm)
    assert f"widened residuals are larger than usual: the ± are widened {factor:.2f} times" in panel


def test_a_record_that_ends_early_is_solved_but_serves_nothing_else(records: list[Path], tmp_path: Path) -> None:
    """Solve says how far it went; calibrate and stats refuse it by name. A whole one is complete."""
    broken = tmp_path / "broken.sqlite"
    with pytest.raises(DeviceFaultError):
        virtual_bench(seed=12, faults=("stage:e-stop@130",)).measure(broken, six_position(20.0))
    assert as_json("solve", records[0])["complete"] is True
    assert "ends before" not in shown("solve", records[0])
    early = as_json("solve", broken)
    assert early["complete"] is False
    with Record(broken) as record:
        said = f"ends before the measurement did, {len(record.steps())} of the 8 steps"
        assert 3 <= len(record.steps()) < 8
    assert f"record {said}" in shown("solve", broken)
    for command in (("calibrate", records[0], broken, "--latitude", 50.429), ("stats", records[0], broken)):
        with pytest.raises(
            RecordError, match=r"broken\.sqlite ends before its measurement did, after \d of the 8 steps"
        ):
            northfinder(*command)
