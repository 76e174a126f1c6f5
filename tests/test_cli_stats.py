"""Campaigns on the emulated bench: what stats says of records, and what find --repeat makes."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from virtual import virtual_bench

from northfinder.cli import cli
from northfinder.cyclogram import four_position, six_position
from northfinder.errors import ConfigError, NorthFinderError, RecordError
from northfinder.record import Record


def stats(*arguments: object) -> str:
    """Run the command and return its standard output; its declared failures are raised."""
    done = CliRunner().invoke(cli, ["stats", *(str(argument) for argument in arguments)])
    if isinstance(done.exception, NorthFinderError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def as_json(*arguments: object) -> dict[str, Any]:
    """Run the command and return its JSON."""
    found: dict[str, Any] = json.loads(stats(*arguments, "--json"))
    return found


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return four records at azimuth 359.9: two in one turn-on, and two more after half an hour and switching off."""
    folder = tmp_path_factory.mktemp("campaign")
    bench = virtual_bench(seed=40, azimuth_deg=359.9)
    paths = [folder / f"{number}.sqlite" for number in range(4)]
    for number, path in enumerate(paths):
        if number == 2:
            bench.clock.sleep_until(bench.clock.now() + 1800.0)
            bench.bench.reset("gyro")
        bench.measure(path, six_position(6.0))
    return paths


def test_the_tables_of_a_campaign(records: list[Path]) -> None:
    """Turn-ons and pause are found, azimuths averaged across north, planes and latitudes as the emulator has them."""
    found = as_json(*reversed(records), "--latitude", 50.429, "--azimuth", 359.9)
    assert (found["n_records"], found["n_turn_ons"]) == (4, 2)
    assert found["pause_h"] == pytest.approx(0.5, abs=0.01)
    assert [row["turn_on"] for row in found["records"]] == [1, 1, 2, 2]
    assert [row["part"] for row in found["records"]] == ["before"] * 2 + ["after"] * 2
    azimuths = np.radians([row["azimuth_deg"] for row in found["records"]])
    off = np.degrees(np.arctan2(np.sin(azimuths), np.cos(azimuths)))
    whole, before = found["azimuth"]["all"], found["azimuth"]["before"]
    assert math.remainder(whole["mean_deg"] - float(np.mean(off)), 360.0) == pytest.approx(0.0, abs=1e-9)
    assert whole["sd_deg"] == pytest.approx(float(np.std(off, ddof=1)))
    assert whole["sd_cos_latitude_deg"] == pytest.approx(whole["sd_deg"] * math.cos(math.radians(50.429)))
    assert before["sd_deg"] == pytest.approx(float(np.std(off[:2], ddof=1)))
    assert abs(whole["error_deg"]) < 1.0
    planes = {name: values["all"]["mean"] for name, values in found["planes"].items()}
    assert planes["bias_horizontal_dph"] == pytest.approx(planes["bias_vertical_dph"], abs=0.5)
    assert planes["scale_factor_horizontal"] == pytest.approx(1.021, abs=0.02)
    assert planes["scale_factor_vertical"] == pytest.approx(1.28, abs=0.02)
    assert planes["ratio"] == pytest.approx(0.797, abs=0.02)
    latitude = found["latitude"]
    assert latitude["plain"]["all"]["error_deg"] == pytest.approx(5.9, abs=0.8)
    assert latitude["with_ratio"]["before"]["error_deg"] == pytest.approx(0.0, abs=0.05)  # k comes from these
    assert abs(latitude["stated"]["all"]["error_deg"]) < 1.0


def test_stated_scatter_is_judged(records: list[Path]) -> None:
    """Normalised errors are those of the records, and the emulator's noise is as large as its profile says."""
    found = as_json(*records, "--latitude", 50.429, "--azimuth", 359.9)
    honest = found["consistency"]
    assert honest["azimuth"]["all"]["dof"] == 3
    assert honest["azimuth"]["within_turn_ons"]["dof"] == 2
    assert honest["latitude"]["against_truth"]["dof"] == 4
    assert all(each["probability"] > 1e-3 for judged in honest.values() for each in judged.values())
    rows = found["records"]
    off = np.array([math.remainder(row["azimuth_deg"], 360.0) for row in rows])
    sd = np.array([row["azimuth_sd_deg"] for row in rows])
    about = off - np.sum(off / sd**2) / np.sum(1.0 / sd**2)
    assert honest["azimuth"]["all"]["rms"] == pytest.approx(math.sqrt(float(np.sum((about / sd) ** 2)) / 3))
    assert honest["azimuth"]["against_truth"]["chi2"] == pytest.approx(float(np.sum(((off + 0.1) / sd) ** 2)))
    shown = " ".join(stats(*records, "--latitude", 50.429).split())
    assert "4 measurements, turn-ons: 2" in shown
    assert "scatter over stated sd" in shown


def test_a_campaign_is_drawn(records: list[Path], tmp_path: Path) -> None:
    """The picture is an SVG, the same for the same data; a folder that is not there is one clear line."""
    first, second = tmp_path / "a.svg", tmp_path / "b.svg"
    for path in (first, second):
        stats(*records, "--plot", path)
    assert first.read_text() == second.read_text()
    assert "<svg" in first.read_text()
    with pytest.raises(RecordError, match="cannot be written"):
        stats(*records[:2], "--plot", tmp_path / "missing" / "c.svg")


def test_what_is_no_campaign_is_said(records: list[Path], tmp_path: Path) -> None:
    """One record, a pause longer than any gap, and a file that is no record are refused by name."""
    with pytest.raises(ConfigError, match="at least two measurements, not 1"):
        stats(records[0])
    with pytest.raises(ConfigError, match=r"no pause of 5 h: the longest between two measurements is 0.5 h"):
        stats(*records, "--pause", 5)
    with pytest.raises(RecordError, match=r"none.sqlite: cannot be read: No such file"):
        stats(records[0], tmp_path / "none.sqlite")


def test_measurements_without_a_vertical_plane_have_no_latitude_table(tmp_path: Path) -> None:
    """Four positions give the scatter of the azimuth, and nothing is made up for the rest."""
    bench = virtual_bench(seed=41)
    paths = [tmp_path / "1.sqlite", tmp_path / "2.sqlite"]
    for path in paths:
        bench.measure(path, four_position(5.0), latitude_deg=50.429)
    found = as_json(*paths)
    assert found["true_latitude_deg"] == pytest.approx(50.429)
    assert found["latitude"] == {}
    assert set(found["planes"]) == {"scale_factor_horizontal"}
    assert set(found["consistency"]) == {"azimuth"}


def test_find_repeated_makes_a_campaign(tmp_path: Path) -> None:
    """Two measurements, two records, one summary with the emulator's truth; all in one turn-on."""
    command = [
        sys.executable, "-m", "northfinder", "find", "--repeat", "2", "--speed", "max", "--seed", "5", "--quiet",
        "--plan", "six-position", "--dwell", "5", "--json", "--out", str(tmp_path),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert len(result["fixes"]) == 2
    assert len(list(tmp_path.glob("*.sqlite"))) == 2
    campaign = result["campaign"]
    assert (campaign["n_records"], campaign["n_turn_ons"], campaign["true_azimuth_deg"]) == (2, 1, 33.0)
    assert campaign["records"][0]["azimuth_deg"] == result["fixes"][0]["azimuth_deg"]
    with Record(Path(result["fixes"][1]["record"])) as record:
        assert record.fixes()[0]["azimuth_deg"] == result["fixes"][1]["azimuth_deg"]
