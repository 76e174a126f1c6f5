"""Azimuth from dwells of a gyro whose bias drifts: right, as sure as it says, and silent where there is nothing."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from northfinder.errors import EstimateError
from northfinder.estimation.dwell_table import DwellTableFix, solve_dwell_table
from northfinder.table_report import dwell_table_json

Array = NDArray[np.float64]

OMEGA = 7.292115e-5
DPH = math.pi / 180.0 / 3600.0
PAIRS = np.radians([0, 180, 270, 90, 45, 225, 315, 135])  # opposite attitudes next to each other
ROUND = np.radians([0, 90, 180, 270, 90, 0, 270, 180])  # and not


def rates(azimuth: Array, elevation: Array, true_azimuth: float, latitude: float, scale: float = 1.0) -> Array:
    """Return the ideal rates of an input axis at `true_azimuth` (deg) plus the stage's."""
    a, lat = math.radians(true_azimuth) + azimuth, math.radians(latitude)
    horizontal = math.cos(lat) * np.cos(elevation) * np.cos(a)
    return np.asarray(scale * OMEGA * (horizontal + math.sin(lat) * np.sin(elevation)))


def off_deg(found: float, true: float) -> float:
    """Return the difference of two azimuths, found in rad, true in deg."""
    return math.degrees(math.remainder(found - math.radians(true), 2.0 * math.pi))


@pytest.mark.parametrize("true_azimuth", [0.0, 33.0, 90.0, 147.0, 180.0, 225.0, 270.0, 359.0])
@pytest.mark.parametrize("latitude", [-65.0, -33.0, 0.5, 50.429, 75.0])
@pytest.mark.parametrize(("order", "method"), [(PAIRS, "half differences"), (ROUND, "random walk")])
def test_without_noise_the_azimuth_is_exact(true_azimuth: float, latitude: float, order: Array, method: str) -> None:
    """Any quadrant and hemisphere, whatever the bias; the scale factor follows from the latitude."""
    azimuth = np.tile(order, 2)
    rate = rates(azimuth, np.zeros(16), true_azimuth, latitude, 0.9) - 1500.0 * DPH
    fix = solve_dwell_table(azimuth, np.zeros(16), rate, latitude=math.radians(latitude))
    assert fix.method == method
    assert off_deg(fix.azimuth, true_azimuth) == pytest.approx(0.0, abs=1e-4)
    assert fix.scale_factor == pytest.approx(0.9, rel=1e-6)
    assert fix.bias / DPH == pytest.approx(-1500.0, rel=1e-6)


def test_a_jump_of_the_bias_between_pairs_does_nothing() -> None:
    """A pair tells only of itself."""
    azimuth = np.tile(PAIRS, 2)
    jumps = np.repeat(np.random.default_rng(3).normal(0.0, 500.0 * DPH, 8), 2)
    fix = solve_dwell_table(azimuth, np.zeros(16), rates(azimuth, np.zeros(16), 33.0, 50.0) + jumps)
    assert off_deg(fix.azimuth, 33.0) == pytest.approx(0.0, abs=1e-4)


def test_the_input_axis_may_point_backward() -> None:
    """With an axis at stage azimuth + 180 deg, the azimuth is still that of the stage's zero."""
    azimuth = np.tile(PAIRS, 2)
    rate = rates(azimuth, np.zeros(16), 33.0 + 180.0, 50.0)
    assert off_deg(solve_dwell_table(azimuth, np.zeros(16), rate).azimuth, 213.0) == pytest.approx(0.0, abs=1e-4)
    turned = solve_dwell_table(azimuth, np.zeros(16), rate, input_axis_offset=math.pi)
    assert off_deg(turned.azimuth, 33.0) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("latitude", [-50.0, 35.0])
def test_vertical_dwells_give_the_latitude(latitude: float) -> None:
    """Up and down among the dwells: latitude and scale factor need nothing given."""
    azimuth, elevation = np.append(PAIRS, np.zeros(4)), np.append(np.zeros(8), np.radians([90, -90, -90, 90]))
    fix = solve_dwell_table(azimuth, elevation, rates(azimuth, elevation, 147.0, latitude, 1.02) + 38.0 * DPH)
    assert fix.latitude == pytest.approx(math.radians(latitude), abs=1e-6)
    assert fix.scale_factor == pytest.approx(1.02, rel=1e-6)
    assert off_deg(fix.azimuth, 147.0) == pytest.approx(0.0, abs=1e-4)


N_RUNS = 300


@pytest.mark.parametrize(("order", "step"), [(PAIRS, 0.0), (ROUND, 0.0), (ROUND, 3.0)])
def test_stated_sd_holds(order: Array, step: float) -> None:
    """Azimuth, horizontal rate and latitude scatter as the residuals say, also on a bias that walks."""
    rng = np.random.default_rng(21)
    azimuth = np.append(np.tile(order, 6), np.zeros(8))
    elevation = np.append(np.zeros(48), np.tile(np.radians([90, -90]), 4))
    truth = rates(azimuth, elevation, 225.0, 40.0)
    errors = []
    for _ in range(N_RUNS):
        noise = rng.normal(0.0, 2.0 * DPH, 56) + np.cumsum(rng.normal(0.0, step * DPH, 56))
        fix = solve_dwell_table(azimuth, elevation, truth + noise)
        assert fix.latitude is not None
        assert fix.latitude_sd is not None
        horizontal_error = fix.horizontal_rate - OMEGA * math.cos(math.radians(40.0))
        errors.append(
            (
                math.radians(off_deg(fix.azimuth, 225.0)) / fix.azimuth_sd,
                horizontal_error / fix.horizontal_rate_sd,
                (fix.latitude - math.radians(40.0)) / fix.latitude_sd,
            )
        )
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    tolerance = 4.0 / math.sqrt(2.0 * N_RUNS) + 0.03  # Student's t of 25 or more degrees of freedom
    assert np.all(np.abs(rms - 1.0) < tolerance), rms


def test_noise_alone_is_refused_but_for_the_stated_false_alarms() -> None:
    """No earth rate in the data: at most the 1 % of false alarms asked for, within 4 sd."""
    rng = np.random.default_rng(22)
    azimuth, n_fixes = np.tile(PAIRS, 3), 0
    for _ in range(1000):
        try:
            solve_dwell_table(azimuth, np.zeros(24), rng.normal(0.0, 20.0 * DPH, 24))
        except EstimateError as error:
            assert "not distinguishable from zero" in str(error)  # noqa: PT017  # most runs must end here, not all
        else:
            n_fixes += 1
    assert 0 < n_fixes < 10 + 4 * math.sqrt(10)


@pytest.mark.parametrize(
    ("azimuth", "reason"),
    [
        (PAIRS[:4], "too few"),
        (np.array([]), "too few"),
        (np.tile([0.0, math.pi], 8), "do not tell north from east"),
        (np.zeros(12), "do not tell north from east"),
    ],
)
def test_dwells_that_do_not_determine_the_azimuth_are_refused(azimuth: Array, reason: str) -> None:
    """Too few dwells, or all along one line."""
    with pytest.raises(EstimateError, match=reason):
        solve_dwell_table(azimuth, np.zeros(len(azimuth)), np.full(len(azimuth), 3.0 * DPH))


def test_a_rate_that_never_changes_is_refused() -> None:
    """A frozen gyro has no horizontal rate."""
    with pytest.raises(EstimateError, match="horizontal rate is zero"):
        solve_dwell_table(np.tile(PAIRS, 2), np.zeros(16), np.full(16, 9.0 * DPH))


def test_the_report_is_in_degrees_and_strict_json() -> None:
    """What is unknown is null."""
    azimuth = np.tile(PAIRS, 2)
    noise = np.random.default_rng(5).normal(0.0, 0.1 * DPH, 16)
    fix: DwellTableFix = solve_dwell_table(azimuth, np.zeros(16), rates(azimuth, np.zeros(16), 33.0, 50.0) + noise)
    report = json.loads(json.dumps(dwell_table_json(fix), allow_nan=False))
    assert report["azimuth_deg"] == pytest.approx(33.0, abs=2.0)
    assert report["horizontal_rate_dph"] == pytest.approx(15.041 * math.cos(math.radians(50.0)), abs=0.3)
    assert report["latitude_deg"] is None
    assert report["n_dwells"] == 16
