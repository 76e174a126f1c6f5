"""The recordings of real instruments, read in place: our figures against those their source gives."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from northfinder.estimation.double_gyrocompass import TriadSolution, solve_triad
from northfinder.estimation.dwell_table import solve_dwell_table
from northfinder.estimation.triad import static_mean
from northfinder.table_report import dwell_table_json, triad_json
from northfinder.tables import DwellTable, StaticTriad, read_table

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def recording(name: str) -> Path:
    """Return the path of a recording, or skip where the recordings are not at hand."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"no recording {path}")
    return path


@pytest.mark.parametrize(
    ("run", "azimuth_deg", "azimuth_sd_deg", "n_dwells"),
    [
        ("t13_1", 2.1, 3.7, 1600),
        ("t16_1", 15.3, 5.3, 960),
        ("t17_1", 24.8, 10.5, 300),
        ("t17_2", -6.4, 9.3, 300),
        ("t17_3", 1.2, 14.7, 300),
        ("t17_4", -43.7, 14.2, 300),
    ],
)
def test_mems_gyro_on_a_turntable(run: str, azimuth_deg: float, azimuth_sd_deg: float, n_dwells: int) -> None:
    """The azimuth of stage zero, with the axis at stage azimuth + 180 deg, as plain least squares has it."""
    table = read_table(recording(f"adxrs290_{run}.csv"))
    assert isinstance(table, DwellTable)
    assert table.metadata["latitude_deg"].startswith("49")
    latitude = math.radians(49.0)
    fix = solve_dwell_table(table.azimuth, table.elevation, table.rate, input_axis_offset=math.pi, latitude=latitude)
    report = dwell_table_json(fix)
    assert report["n_dwells"] == n_dwells
    assert math.remainder(report["azimuth_deg"] - azimuth_deg, 360.0) == pytest.approx(0.0, abs=0.3 * azimuth_sd_deg)
    assert report["azimuth_sd_deg"] == pytest.approx(azimuth_sd_deg, rel=0.12)
    assert report["horizontal_rate_dph"] == pytest.approx(9.87, abs=3.0 * report["horizontal_rate_sd_dph"])


def solve_ln100(latitude: float | None = None) -> TriadSolution:
    """Solve the ring-laser triad, x up and then x down."""
    table = read_table(recording("ln100_two_position_1hz.csv"))
    assert isinstance(table, StaticTriad)
    return solve_triad([static_mean(p.name, p.rate, p.specific_force) for p in table.positions], latitude=latitude)


def test_ring_laser_triad_in_two_positions() -> None:
    """Biases below 0.5 deg/h, the latitude within 0.5 deg and 3 sd of 51.0784, headings of both positions alike."""
    report = triad_json(solve_ln100())
    assert report["latitude_deg"] == pytest.approx(51.0784, abs=0.5)
    assert report["latitude_deg"] == pytest.approx(51.0784, abs=3.0 * report["latitude_sd_deg"])
    assert all(abs(bias) < 0.5 for bias in report["bias_dph"])
    assert report["bias_dph"][0] == pytest.approx((11.48 - 11.99) / 2.0, abs=0.1)  # half sum of x up and x down
    assert report["axes"]["x"]["azimuth_deg"] is None
    assert report["axes"]["x"]["elevation_deg"] == pytest.approx(89.66, abs=0.01)
    up, down = (report["positions"][name]["combined_axes"]["y"]["azimuth_deg"] for name in ("up", "down"))
    assert up == pytest.approx(down, abs=1.0)  # the body was turned about y, which was not told


def test_ring_laser_triad_position_by_position() -> None:
    """Alone each position is up to 1.3 deg off in latitude by its biases, and its sd knows."""
    report = triad_json(solve_ln100())
    for alone in report["positions"].values():
        assert alone["latitude_deg"] == pytest.approx(51.0784, abs=3.0 * alone["latitude_sd_deg"])
        assert alone["latitude_deg"] == pytest.approx(51.0784, abs=1.5)
        combined = alone["combined_axes"]["y"]
        sd = math.hypot(alone["axes"]["y"]["azimuth_sd_deg"], combined["azimuth_sd_deg"])
        assert alone["axes"]["y"]["azimuth_deg"] == pytest.approx(combined["azimuth_deg"], abs=3.0 * sd)
    assert set(report["positions"]) == {"up", "down"}


def test_ring_laser_triad_at_the_known_latitude() -> None:
    """The latitude given, biases and headings stay within the sd found without it."""
    free, held = solve_ln100().combined, solve_ln100(latitude=math.radians(51.0784)).combined
    assert free.bias is not None
    assert free.bias_sd is not None
    assert held.bias is not None
    assert all(abs(held.bias - free.bias) < free.bias_sd)
