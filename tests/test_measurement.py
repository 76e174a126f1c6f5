"""Whole measurements on the emulated bench in virtual time: truth found, stated right, found again from the record."""

import math
from pathlib import Path

import numpy as np
import pytest
from virtual import assume, virtual_bench

from drivers.api import GyroStatus, RateBlock
from northfinder.cyclogram import four_position, six_position
from northfinder.errors import ConfigError, EstimateError
from northfinder.record import DwellSpan
from northfinder.reduction import Reduction
from northfinder.solve_file import solve_file, solve_record

SPAN = DwellSpan(
    step=2, name="U3", azimuth=0.0, elevation=0.0, dwell=3.0, measured_azimuth=3.0, measured_elevation=0.1,
    first_index=105, stop_index=135, sample_rate=10.0,
)  # fmt: skip


def block(first_index: int, n: int, *, status: GyroStatus = GyroStatus.OK, tilt: float = 0.0) -> RateBlock:
    """Return a block whose rate in rad/s equals the index of each sample."""
    return RateBlock(
        first_index=first_index, device_time=0.0, arrival_time=0.0, rate_lsb=1.0, status=status, tilt=(tilt, -tilt),
        counts=np.arange(first_index, first_index + n, dtype=np.int32).reshape(-1, 1),
    )  # fmt: skip


def test_a_dwell_becomes_means_of_a_second() -> None:
    """Samples outside the dwell are cut off, the rest is averaged by the second, with attitude and tilt."""
    reduction = Reduction()
    reduction.add(SPAN, [block(100, 20, tilt=0.1), block(120, 20, tilt=0.3)])
    means = reduction.means()
    assert means.rate[:, 0].tolist() == [109.5, 119.5, 129.5]
    assert means.start.tolist() == [10.5, 11.5, 12.5]
    assert means.duration.tolist() == [1.0, 1.0, 1.0]
    assert set(means.azimuth) == {3.0}
    assert means.tilt[0].tolist() == [pytest.approx(0.2), pytest.approx(-0.2)]
    assert set(means.dwell) == {2}
    assert (reduction.n_unfit, reduction.n_missing) == (0, 0)


def test_gaps_and_unfit_samples_are_left_out_and_counted() -> None:
    """A mean never spans a gap, and never holds a sample that the gyro declared unfit."""
    reduction = Reduction()
    reduction.add(
        SPAN,
        [block(100, 12), block(118, 4), block(122, 4, status=GyroStatus.SATURATED), block(126, 20)],
    )
    means = reduction.means()
    assert means.rate[:, 0].tolist() == [108.0, 119.5, 130.0]
    assert means.n_samples.tolist() == [7, 4, 9]
    assert (reduction.n_unfit, reduction.n_missing) == (4, 6)


def test_overruns_do_not_make_samples_unfit() -> None:
    """Lost samples are seen in the index; those that came are good."""
    reduction = Reduction()
    reduction.add(SPAN, [block(105, 30, status=GyroStatus.OVERRUN | GyroStatus.TILT_INVALID, tilt=9.0)])
    assert reduction.means().n == 3
    assert not reduction.means().tilt.any()


def test_nothing_usable_is_a_named_reason() -> None:
    """A dwell of nothing but unfit samples gives no estimate, and says so."""
    reduction = Reduction()
    reduction.add(SPAN, [block(100, 40, status=GyroStatus.SENSOR_FAULT)])
    with pytest.raises(EstimateError, match="no dwell was finished with samples fit for use"):
        reduction.means()


def test_solve_on_the_record_gives_the_live_fix_bit_for_bit(tmp_path: Path) -> None:
    """The same reduction and the same estimate: every figure equal, not merely close."""
    outcome = virtual_bench(seed=5).measure(tmp_path / "r.sqlite", six_position(20.0))
    again = solve_record(tmp_path / "r.sqlite")
    live = outcome.to_json()
    assert {name: again[name] for name in again if name in live} == {name: live[name] for name in again if name in live}
    assert again["azimuth_deg"] == live["azimuth_deg"]
    other = solve_file(tmp_path / "r.sqlite", assume(method="ordinary"))
    assert other["azimuth_deg"] != live["azimuth_deg"]


@pytest.mark.parametrize(("azimuth_deg", "latitude_deg"), [(33, 50.429), (147, -33), (270, 20), (359, 75)])
def test_the_truth_lies_within_the_statement(tmp_path: Path, azimuth_deg: float, latitude_deg: float) -> None:
    """Azimuth and latitude within four stated standard deviations, in all quadrants and both hemispheres."""
    bench = virtual_bench(seed=int(azimuth_deg), azimuth_deg=azimuth_deg, latitude_deg=latitude_deg)
    fix = bench.measure(tmp_path / "r.sqlite", six_position(30.0)).fix
    assert abs(math.remainder(fix.azimuth - math.radians(azimuth_deg), 2 * math.pi)) < 4 * fix.azimuth_sd
    assert fix.latitude is not None
    assert fix.latitude_sd is not None
    assert abs(fix.latitude - math.radians(latitude_deg)) < 4 * fix.latitude_sd
    assert math.degrees(fix.azimuth_sd) * math.cos(math.radians(latitude_deg)) < 0.2


def test_an_ideal_gyro_finds_the_truth_exactly(tmp_path: Path) -> None:
    """Without noise the whole chain is right to a few arc seconds: the mechanics' and quantisation's share."""
    bench = virtual_bench("ideal", azimuth_deg=222.0, latitude_deg=-41.0)
    fix = bench.measure(tmp_path / "r.sqlite", six_position(10.0), profile=None).fix
    assert math.degrees(fix.azimuth) == pytest.approx(222.0, abs=0.003)
    assert fix.latitude is not None
    assert math.degrees(fix.latitude) == pytest.approx(-41.0, abs=0.003)


def test_four_positions_give_the_azimuth_and_say_why_no_latitude(tmp_path: Path) -> None:
    """Without vertical positions the latitude is a named reason, and with a known one the scale factor follows."""
    bench = virtual_bench(seed=9)
    outcome = bench.measure(tmp_path / "r.sqlite", four_position(20.0))
    assert outcome.fix.latitude is None
    assert "vertical" in outcome.to_json()["latitude_reason"]
    known = solve_file(tmp_path / "r.sqlite", assume(latitude_deg=50.429))
    assert known["scale_factor"] == pytest.approx(1.021, abs=0.02)


def test_the_unknown_g_drift_goes_into_the_latitude_as_predicted(tmp_path: Path) -> None:
    """3 deg/h/g taken for zero shifts the latitude to the paper's 56 deg, and leaves the azimuth alone."""
    bench = virtual_bench(seed=4)
    bench.measure(tmp_path / "r.sqlite", six_position(30.0))
    right = solve_file(tmp_path / "r.sqlite", assume())
    wrong = solve_file(tmp_path / "r.sqlite", assume(g_drift_dph=0.0))
    earth, latitude, scale = 15.041067, math.radians(50.429), 1.021
    predicted = math.degrees(math.atan2(scale * earth * math.sin(latitude) + 3.0, scale * earth * math.cos(latitude)))
    assert wrong["latitude_deg"] - right["latitude_deg"] == pytest.approx(predicted - 50.429, abs=0.05)
    assert wrong["latitude_deg"] == pytest.approx(56.0, abs=1.0)
    assert wrong["azimuth_deg"] == pytest.approx(right["azimuth_deg"], abs=1e-3)


def test_the_published_formulas_stand_beside_the_fix(tmp_path: Path) -> None:
    """(2), (3) and (10) on the published positions: near the fix, but for the drift that (3) does not know of."""
    outcome = virtual_bench(seed=12).measure(tmp_path / "r.sqlite", six_position(30.0)).to_json()
    published = outcome["closed_form"]
    assert published["azimuth_deg"] == pytest.approx(outcome["azimuth_deg"], abs=4 * published["azimuth_sd_deg"])
    assert published["latitude_deg"] == pytest.approx(56.6, abs=4 * published["latitude_sd_deg"])
    assert published["bias_horizontal_dph"] == pytest.approx(outcome["bias_dph"], abs=0.5)
    assert published["scale_factor_horizontal"] == pytest.approx(1.021, abs=0.03)
    assert published["scale_factor_vertical"] == pytest.approx(1.28, abs=0.03)


def test_a_bad_constant_is_refused() -> None:
    """A drift rate that is no number is the operator's mistake."""
    with pytest.raises(ConfigError, match="finite number, not nan"):
        assume(g_drift_dph=math.nan)
