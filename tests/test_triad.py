"""Gyrocompassing with a triad: right from known attitudes, and as sure as it says."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from northfinder.errors import EstimateError
from northfinder.estimation.double_gyrocompass import double_gyrocompass, solve_triad
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.triad import AxisDirection, StaticMean, TriadFix, gyrocompass, static_mean
from northfinder.profile import find_profile
from northfinder.solution import Assumptions
from northfinder.solve_file import solve_file
from northfinder.table_report import triad_json

Array = NDArray[np.float64]

OMEGA = 7.292115e-5
DPH = math.pi / 180.0 / 3600.0
KINDS = ("gyro", "rad_s"), ("accel", "ms2")
NO_BIAS = np.zeros(3)


def attitude(heading: float, pitch: float, roll: float) -> Array:
    """Return the matrix from the body to north, east, down; degrees in."""
    return np.asarray(Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix())


def mean_of(mat_nb: Array, latitude: float, bias: Array = NO_BIAS, sd: float = 1e-12, name: str = "p") -> StaticMean:
    """Return ideal means in an attitude, plus `bias`."""
    lat = math.radians(latitude)
    rate = mat_nb.T @ (OMEGA * np.array([math.cos(lat), 0.0, -math.sin(lat)])) + bias
    force = mat_nb.T @ np.array([0.0, 0.0, -9.81])
    sds = {"rate_sd": np.full(3, sd), "specific_force_sd": np.full(3, 1e-9)}
    return StaticMean(name=name, rate=rate, specific_force=force, n_samples=100, degrees_of_freedom=19, **sds)


def noisy(mean: StaticMean, sd: float, force_sd: float, rng: np.random.Generator) -> StaticMean:
    """Return means with errors of known standard deviations."""
    return StaticMean(
        name=mean.name,
        rate=mean.rate + rng.normal(0.0, sd, 3),
        rate_sd=np.full(3, sd),
        specific_force=mean.specific_force + rng.normal(0.0, force_sd, 3),
        specific_force_sd=np.full(3, force_sd),
        n_samples=100,
        degrees_of_freedom=19,
    )


def off(found: float | None, true: float) -> float:
    """Return the difference of two angles, rad, within half a turn."""
    assert found is not None
    return math.remainder(found - true, 2.0 * math.pi)


def true_azimuth(mat_nb: Array, axis: int) -> float:
    """Return the azimuth of a body axis."""
    return math.atan2(mat_nb[1, axis], mat_nb[0, axis])


def true_elevation(mat_nb: Array, axis: int) -> float:
    """Return the elevation of a body axis."""
    return -math.asin(np.clip(mat_nb[2, axis], -1.0, 1.0))


def check_axes(axes: Sequence[AxisDirection], mat_nb: Array, tolerance: float = 1e-6) -> None:
    """Compare the directions of axes that are not vertical with the truth."""
    for axis, found in enumerate(axes):
        assert found.elevation == pytest.approx(true_elevation(mat_nb, axis), abs=tolerance)
        if found.azimuth is not None:
            assert off(found.azimuth, true_azimuth(mat_nb, axis)) == pytest.approx(0.0, abs=tolerance)


@pytest.mark.parametrize("latitude", [-75.0, -33.0, 0.0, 0.5, 50.429, 85.0])
@pytest.mark.parametrize("angles", [(0, 0, 0), (33, 4, -7), (118, 0, 180), (205, 60, 20), (290, -80, 95), (359, 0, 90)])
def test_one_position_without_bias_is_exact(latitude: float, angles: tuple[float, float, float]) -> None:
    """Any attitude, all quadrants, both hemispheres and the equator."""
    mat_nb = attitude(*angles)
    fix = gyrocompass(mean_of(mat_nb, latitude))
    assert fix.latitude == pytest.approx(math.radians(latitude), abs=1e-6)
    check_axes(fix.axes[0], mat_nb)
    assert fix.bias is None
    assert sum(axis.azimuth is None for axis in fix.axes[0]) == sum(np.abs(mat_nb[2]) > math.cos(math.radians(1.0)))


def test_a_vertical_axis_has_no_azimuth_but_a_reason() -> None:
    """Level, x ahead: z points down, and says so instead of giving a number."""
    x, y, z = gyrocompass(mean_of(attitude(40.0, 0.3, 0.2), 50.0)).axes[0]
    assert (x.azimuth is None, y.azimuth is None, z.azimuth is None) == (False, False, True)
    assert z.azimuth_sd is None
    assert "vertical" in z.reason
    assert z.elevation == pytest.approx(-math.pi / 2, abs=0.01)


def test_at_the_pole_no_axis_has_an_azimuth() -> None:
    """The latitude stands, the azimuth is refused by name."""
    mean = mean_of(attitude(40.0, 2.0, 3.0), 90.0, sd=0.01 * DPH)
    fix = gyrocompass(mean)
    assert fix.latitude == pytest.approx(math.pi / 2, abs=0.01)
    assert all(axis.azimuth is None and axis.reason for axis in fix.axes[0])
    with pytest.raises(EstimateError, match="horizontal rate"):
        solve_triad([mean])


def test_a_wrong_norm_widens_the_standard_deviation() -> None:
    """A bias along the rate shows in its norm; 1 deg/h of 15 is 3.8 deg of latitude, and is said."""
    clean = mean_of(attitude(40.0, 0.0, 0.0), 50.0, sd=0.01 * DPH)
    biased = mean_of(attitude(40.0, 0.0, 0.0), 50.0, bias=clean.rate / OMEGA * DPH, sd=0.01 * DPH)
    assert math.degrees(gyrocompass(clean).latitude_sd) == pytest.approx(0.038, rel=0.02)
    fix = gyrocompass(biased)
    assert math.degrees(fix.latitude_sd) == pytest.approx(3.57, rel=0.02)  # 1 deg/h against now 16
    assert any("16.041 deg/h" in note for note in fix.notes)


def test_a_stated_bias_is_in_the_standard_deviation() -> None:
    """The azimuth's is the bias over the horizontal earth rate, the elevation's that of the accelerometer over g."""
    mean = mean_of(attitude(40.0, 0.0, 0.0), 50.0)
    fix = gyrocompass(mean, gyro_bias_sd=0.1 * DPH, accelerometer_bias_sd=0.001)
    tilt = 0.001 / 9.81
    azimuth_sd = math.hypot(0.1 * DPH / (OMEGA * math.cos(math.radians(50.0))), tilt * math.tan(math.radians(50.0)))
    assert fix.axes[0][0].azimuth_sd == pytest.approx(azimuth_sd, rel=0.01)
    assert fix.axes[0][0].elevation_sd == pytest.approx(tilt, rel=0.01)
    assert not any("unknown" in note for note in fix.notes)
    assert any("unknown" in note for note in gyrocompass(mean).notes)


def test_what_is_not_gravity_is_refused() -> None:
    """Accelerations in g under the name of m/s^2."""
    mean = mean_of(attitude(0.0, 0.0, 0.0), 50.0)
    wrong = StaticMean(
        name="p", rate=mean.rate, rate_sd=mean.rate_sd, specific_force=mean.specific_force / 9.81,
        specific_force_sd=mean.specific_force_sd, n_samples=100, degrees_of_freedom=19,
    )  # fmt: skip
    with pytest.raises(EstimateError, match="position 'p': the specific force is 1 m/s"):
        gyrocompass(wrong)
    with pytest.raises(EstimateError, match="another unit"):
        double_gyrocompass([mean, wrong])


BIAS = np.array([0.4, -0.3, 0.25]) * DPH
OVER = (attitude(70.0, 90.0, 10.0), attitude(200.0, -90.0, 5.0))  # x down, x up, after an unknown turn


@pytest.mark.parametrize("latitude", [-65.0, -20.0, 0.0, 30.0, 51.0, 75.0])
@pytest.mark.parametrize(
    "attitudes",
    [
        OVER,
        (attitude(70.0, 2.0, 3.0), attitude(140.0, 2.0, 178.0)),
        (attitude(10.0, 0.0, 0.0), attitude(10.0, 0.0, 90.0), attitude(280.0, 90.0, 0.0), attitude(33.0, 5.0, 120.0)),
    ],
)
def test_positions_turned_over_give_biases_latitude_and_headings(latitude: float, attitudes: tuple[Array, ...]) -> None:
    """Common biases drop out, by turns nobody told."""
    fix = double_gyrocompass([mean_of(mat, latitude, BIAS) for mat in attitudes])
    assert fix.bias is not None
    np.testing.assert_allclose(fix.bias / DPH, BIAS / DPH, atol=1e-4)
    assert fix.latitude == pytest.approx(math.radians(latitude), abs=1e-5)
    for axes, mat in zip(fix.axes, attitudes, strict=True):
        check_axes(axes, mat, 1e-4)


def test_turns_about_the_vertical_need_to_be_known() -> None:
    """0 and 180 deg of the double gyrocompass: refused without the turn, right with it."""
    level = attitude(33.0, 0.0, 0.0), attitude(213.0, 0.0, 0.0)
    with pytest.raises(EstimateError, match="do not determine gyro biases"):
        double_gyrocompass([mean_of(mat, 50.0, BIAS, sd=0.01 * DPH) for mat in level])
    bias = np.array([3.0, -2.0, 0.5]) * DPH
    means = [mean_of(mat, 50.0, bias, sd=0.01 * DPH) for mat in level]
    fix = double_gyrocompass(means, turns=[0.0, math.pi], turn_sd=math.radians(1.0 / 60.0))
    check_axes(fix.axes[0], level[0], 1e-3)
    assert fix.bias is not None
    np.testing.assert_allclose(fix.bias / DPH, bias / DPH, atol=0.01)


def test_a_known_latitude_is_used() -> None:
    """It holds the latitude fast and sharpens the bias along the vertical."""
    means = [mean_of(mat, 50.0, BIAS, sd=0.05 * DPH) for mat in OVER]
    free, held = double_gyrocompass(means), double_gyrocompass(means, latitude=math.radians(50.0))
    assert held.latitude == pytest.approx(math.radians(50.0), abs=1e-6)
    assert held.latitude_sd < 1e-6 < free.latitude_sd


def test_two_sets_of_biases_that_fit_alike_are_refused() -> None:
    """Biases of the size of the earth rate have a mirror image; saying how large they can be is one way out."""
    bias = np.array([0.0, 9.0, -4.0]) * DPH
    means = [mean_of(mat, 50.0, bias, sd=0.05 * DPH) for mat in OVER]
    with pytest.raises(EstimateError, match="fit alike"):
        double_gyrocompass(means)


def test_positions_alone_carry_the_biases_that_all_show() -> None:
    """The sd of a position alone is no smaller than what the common biases do to it."""
    solution = solve_triad([mean_of(mat, 50.0, BIAS, sd=0.01 * DPH, name=n) for mat, n in zip(OVER, "ab", strict=True)])
    for alone in solution.positions:
        assert abs(alone.latitude - math.radians(50.0)) < 3.0 * alone.latitude_sd
    assert solution.combined.latitude_sd < solution.positions[0].latitude_sd


N_RUNS = 200
#: rms of N_RUNS normalised errors, 4 standard deviations: 1 +- 4 / sqrt(2 n).
BOUNDS = (1.0 - 4.0 / math.sqrt(2.0 * N_RUNS), 1.0 + 4.0 / math.sqrt(2.0 * N_RUNS))


def normalised_errors(fix: TriadFix, attitudes: Sequence[Array], latitude: float) -> list[float]:
    """Return errors over their stated sd: latitude, azimuth and elevation of an axis."""
    axis = next(i for i, axis in enumerate(fix.axes[0]) if axis.azimuth is not None)
    found, mat = fix.axes[0][axis], attitudes[0]
    assert found.azimuth_sd is not None
    return [
        (fix.latitude - math.radians(latitude)) / fix.latitude_sd,
        off(found.azimuth, true_azimuth(mat, axis)) / found.azimuth_sd,
        (found.elevation - true_elevation(mat, axis)) / found.elevation_sd,
    ]


def test_stated_sd_of_two_positions_holds() -> None:
    """Latitude, azimuth, elevation and the three biases scatter as they say, with unknown biases.

    Three angles and three biases of 70 runs are 210 errors each, as powerful as 200 runs of one.
    """
    rng = np.random.default_rng(11)
    attitudes = attitude(70.0, 80.0, 10.0), attitude(150.0, -75.0, 25.0)
    errors, of_bias = [], []
    for _ in range(70):
        bias = rng.normal(0.0, 0.5 * DPH, 3)
        means = [noisy(mean_of(mat, 40.0, bias), 0.02 * DPH, 1e-3, rng) for mat in attitudes]
        fix = double_gyrocompass(means)
        assert fix.bias is not None
        assert fix.bias_sd is not None
        errors.append(normalised_errors(fix, attitudes, 40.0))
        of_bias.append((fix.bias - bias) / fix.bias_sd)
    for found in (errors, of_bias):  # 210 errors each
        rms = float(np.sqrt(np.mean(np.square(found))))
        assert BOUNDS[0] < rms < BOUNDS[1]


def test_correlated_noise_of_the_positions_is_weighed_and_stated() -> None:
    """Four positions of a gyro that wanders: the sd hold with its covariance, and the errors are smaller with it."""
    rng = np.random.default_rng(14)
    attitudes = [attitude(*a) for a in ((70, 80, 10), (150, -75, 25), (20, 5, 95), (300, 10, -85))]
    start, zero = np.array([0.0, 60.0, 120.0, 900.0]), np.zeros(4)
    spans = RateMeans(start=start, duration=[60.0, 60.0, 60.0, 600.0], rate=zero, azimuth=zero, elevation=zero)
    wander = NoiseModel.from_field_units(
        angle_random_walk_deg_per_sqrt_h=0.001, bias_instability_dph=0.02, rate_random_walk_dph_per_sqrt_h=0.4
    )
    covariance = wander.covariance(spans)
    errors = []
    for _ in range(70):
        noise = rng.multivariate_normal(zero, covariance, 3).T
        means = [mean_of(mat, 40.0, BIAS + of, 0.001 * DPH) for mat, of in zip(attitudes, noise, strict=True)]
        fixes = double_gyrocompass(means, rate_covariance=covariance), double_gyrocompass(means)
        stated = normalised_errors(fixes[0], attitudes, 40.0)[:2]
        errors.append([*stated, *((fix.latitude - math.radians(40.0)) for fix in fixes)])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    limit = 4.0 / math.sqrt(2.0 * 70)
    assert np.all(np.abs(rms[:2] - 1.0) < limit), rms
    assert rms[2] < 0.9 * rms[3]


def test_stated_sd_of_one_position_holds() -> None:
    """With the bias stated, latitude and azimuth scatter by at least what is said and at most a third more is said."""
    rng = np.random.default_rng(12)
    mat = attitude(215.0, 12.0, -30.0)
    errors = []
    for _ in range(N_RUNS):
        mean = noisy(mean_of(mat, -40.0, rng.normal(0.0, 0.1 * DPH, 3)), 0.02 * DPH, 1e-2, rng)
        errors.append(normalised_errors(gyrocompass(mean, gyro_bias_sd=0.1 * DPH), [mat], -40.0))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all((rms > BOUNDS[0] / 1.34) & (rms < BOUNDS[1])), rms


@pytest.mark.parametrize("smoothing", [1, 30])
def test_sd_of_a_mean_is_not_fooled_by_correlation(smoothing: int) -> None:
    """White noise, and noise that is alike over 30 samples of 3000: Student's t with 19 degrees of freedom."""
    rng = np.random.default_rng(13)
    ratios = []
    for _ in range(100):
        white = rng.normal(size=(3000 + smoothing - 1, 6))
        sums = np.cumsum(np.vstack([np.zeros((1, 6)), white]), axis=0)
        samples = sums[smoothing:] - sums[:-smoothing]
        mean = static_mean("p", samples[:, :3], samples[:, 3:])
        ratios += [*(mean.rate / mean.rate_sd), *(mean.specific_force / mean.specific_force_sd)]
    rms = math.sqrt(np.mean(np.square(ratios)) * 17.0 / 19.0)
    assert 1.0 - 4.0 / math.sqrt(1200.0) < rms < 1.1 + 4.0 / math.sqrt(1200.0)
    assert mean.degrees_of_freedom == 19


def test_too_few_samples_are_refused() -> None:
    """Nine samples give no standard deviation worth the name."""
    with pytest.raises(EstimateError, match="position 'up' has 9 samples, expected at least 10"):
        static_mean("up", np.zeros((9, 3)), np.zeros((9, 3)))


def test_the_report_has_every_field_and_no_nan() -> None:
    """Degrees and deg/h, by axis and position, ready for strict JSON."""
    attitudes = attitude(70.0, 90.0, 10.0), attitude(70.0, -90.0, 10.0)
    means = [mean_of(mat, 50.0, BIAS, sd=0.01 * DPH, name=n) for mat, n in zip(attitudes, ("up", "down"), strict=True)]
    report = json.loads(json.dumps(triad_json(solve_triad(means)), allow_nan=False))
    assert report["latitude_deg"] == pytest.approx(50.0, abs=0.01)
    assert report["bias_dph"] == pytest.approx([0.4, -0.3, 0.25], abs=0.01)
    assert set(report["axes"]) == {"x", "y", "z"}
    assert report["axes"]["x"]["azimuth_deg"] is None
    assert report["axes"]["y"]["azimuth_deg"] == pytest.approx(
        math.degrees(true_azimuth(attitudes[0], 1)) % 360, abs=0.1
    )
    assert list(report["positions"]) == ["up", "down"]
    for alone in report["positions"].values():
        assert {"axes", "latitude_deg", "latitude_sd_deg", "bias_dph", "combined_axes"} <= set(alone)


def test_a_profile_weighs_the_positions_of_a_file(tmp_path: Path) -> None:
    """Data with hardly any scatter of their own are as sure as the gyro's noise model allows, and a note says so."""
    rng = np.random.default_rng(15)
    lines = ["position,time_s," + ",".join(f"{kind}_{axis}_{u}" for kind, u in KINDS for axis in "xyz")]
    for n, mat in enumerate((attitude(70.0, 80.0, 10.0), attitude(150.0, -75.0, 25.0))):
        mean = mean_of(mat, 40.0, BIAS)
        row = np.concatenate([mean.rate, mean.specific_force])
        noise = rng.normal(0.0, 1e-9, (40, 6))
        lines += [f"p{n},{60 * n + i}," + ",".join(map(repr, (row + noise[i]).tolist())) for i in range(40)]
    path = tmp_path / "triad.csv"
    path.write_text("\n".join(lines))
    plain = solve_file(path, None)
    weighed = solve_file(path, Assumptions(profile=find_profile("triad")))
    assert weighed["latitude_deg"] == pytest.approx(plain["latitude_deg"], abs=0.01)
    # Two means of 40 s with 0.002 deg/sqrt(h): 0.019 deg/h each of the earth's 15, the latitude 0.05 to 0.15 deg.
    assert plain["latitude_sd_deg"] < 0.01
    assert 0.05 < weighed["latitude_sd_deg"] < 0.15
    assert any("noise model" in note for note in weighed["notes"])
