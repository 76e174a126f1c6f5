"""Least squares from interval means to azimuth and latitude: exact without noise, or a reason by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from simulated_means import DPH, OMEGA_DPH, SIX, TVG43, U1, U2, U3, U4, U5, U6, draw_noise, make_means

from northfinder.errors import EstimateError
from northfinder.estimation import Fix, Known, NoiseModel, RateMeans, estimate
from northfinder.estimation.geometry import sensitivity
from northfinder.estimation.least_squares import Weights
from northfinder.estimation.linear import Drift

NOISE = NoiseModel.from_field_units(**TVG43)
FOUR = (U1, U2, U3, U4)


def azimuth_error_deg(fix: Fix, azimuth_deg: float) -> float:
    """Signed error of the azimuth, the short way round."""
    return (math.degrees(fix.azimuth) - azimuth_deg + 180.0) % 360.0 - 180.0


def latitude_deg(fix: Fix) -> float:
    """Latitude of a fix that must have one."""
    assert fix.latitude is not None
    return math.degrees(fix.latitude)


def failed(fix: Fix) -> list[str]:
    """Names of the checks that did not pass."""
    return [check.name for check in fix.checks if not check.passed]


@settings(max_examples=60, deadline=None)
@given(
    azimuth_deg=st.floats(0.0, 360.0),
    latitude=st.floats(-85.0, 85.0),
    tilt=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    scale_factor=st.floats(0.7, 1.3),
    bias_dph=st.floats(-1000.0, 1000.0),
    drift_dph_per_h=st.floats(-50.0, 50.0),
    d_g_dph=st.floats(-5.0, 5.0),
    weights=st.sampled_from(["ordinary", "generalised"]),
)
def test_without_noise_every_attitude_is_found_exactly(
    azimuth_deg: float,
    latitude: float,
    tilt: tuple[float, float],
    weights: Weights,
    scale_factor: float,
    bias_dph: float,
    drift_dph_per_h: float,
    d_g_dph: float,
) -> None:
    """All quadrants, both hemispheres, any tilt, bias, drift and scale factor give back what was put in."""
    means = make_means(
        azimuth_deg,
        latitude,
        tilt=tilt,
        scale_factor=scale_factor,
        bias_dph=bias_dph,
        drift_dph_per_h=drift_dph_per_h,
        d_g_dph=d_g_dph,
    )
    known = Known(acceleration_sensitive_drift_rate=d_g_dph * DPH)
    fix = estimate(means, noise=NOISE, known=known, drift="linear", weights=weights)
    assert azimuth_error_deg(fix, azimuth_deg) == pytest.approx(0.0, abs=1e-6)
    assert latitude_deg(fix) == pytest.approx(latitude, abs=1e-6)
    assert fix.scale_factor == pytest.approx(scale_factor, rel=1e-6)
    assert fix.bias[0] / DPH == pytest.approx(bias_dph, abs=1e-6)
    assert fix.drift_rate[0] / DPH * 3600.0 == pytest.approx(drift_dph_per_h, abs=1e-5)


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 180.0, 270.0, 359.999999])
@pytest.mark.parametrize("latitude", [-80.0, 0.0, 45.0])
def test_on_an_axis_and_on_the_equator_nothing_is_divided_by_zero(azimuth_deg: float, latitude: float) -> None:
    """Azimuths exactly on an axis, at the equator too, are right, and every figure is a number."""
    fix = estimate(make_means(azimuth_deg, latitude), noise=NOISE)
    assert abs(azimuth_error_deg(fix, azimuth_deg)) < 1e-6
    assert 0.0 <= fix.azimuth < 2.0 * math.pi
    assert abs(latitude_deg(fix) - latitude) < 1e-6
    assert all(math.isfinite(check.value) and math.isfinite(check.limit) for check in fix.checks)


def test_two_dwells_a_turn_in_any_order_give_the_same_fix() -> None:
    """The estimate needs no named positions: odd azimuths and elevations serve."""
    positions = ((13, 5), (131, -20), (247, 40), (300, -60), (20, 80), (170, 0), (13, 5))
    fix = estimate(make_means(147.0, -33.0, positions=positions), noise=NOISE, weights="generalised")
    assert azimuth_error_deg(fix, 147.0) == pytest.approx(0.0, abs=1e-6)
    assert latitude_deg(fix) == pytest.approx(-33.0, abs=1e-6)


def test_ignoring_a_tilt_costs_what_the_method_says() -> None:
    """A tilt t toward east turns the azimuth by t tan(lat); toward north it goes into the latitude, one to one."""
    tilt = math.radians(0.1)
    east = make_means(0.0, 50.0, tilt=(0.0, tilt))
    north = make_means(0.0, 50.0, tilt=(tilt, 0.0))
    level = np.zeros((8, 2))
    wrong_azimuth = estimate(replaced(east, tilt=level), noise=NOISE)
    wrong_latitude = estimate(replaced(north, tilt=level), noise=NOISE)
    assert abs(azimuth_error_deg(wrong_azimuth, 0.0)) == pytest.approx(0.1 * math.tan(math.radians(50.0)), rel=0.01)
    assert abs(latitude_deg(wrong_latitude) - 50.0) == pytest.approx(0.1, rel=0.01)
    unsure = estimate(replaced(east, tilt=level), noise=NOISE, known=Known(tilt_sd=tilt))
    sure = estimate(replaced(east, tilt=level), noise=NOISE)
    grown = math.sqrt(unsure.azimuth_sd**2 - sure.azimuth_sd**2)
    assert grown == pytest.approx(tilt * math.tan(math.radians(50.0)), rel=0.01)
    assert unsure.latitude_sd is not None
    assert sure.latitude_sd is not None
    assert math.sqrt(unsure.latitude_sd**2 - sure.latitude_sd**2) == pytest.approx(tilt, rel=0.01)


def replaced(means: RateMeans, **changes: ArrayLike) -> RateMeans:
    """Means with some arrays replaced."""
    names = ("start", "duration", "rate", "azimuth", "elevation", "tilt", "dwell", "n_samples")
    return RateMeans(**{name: getattr(means, name) for name in names} | changes)


def test_generalised_equals_ordinary_for_white_noise() -> None:
    """With angle random walk alone and equal means the noise model changes nothing but knows the size."""
    white = NoiseModel.from_field_units(angle_random_walk_deg_per_sqrt_h=0.01)
    means = make_means(225.0, 20.0, mean=10.0)
    means = means.with_rate(means.rate[:, 0] + 0.1 * DPH * np.random.default_rng(2).standard_normal(means.n))
    ordinary = estimate(means, noise=white, weights="ordinary", drift="linear")
    generalised = estimate(means, noise=white, weights="generalised", drift="linear")
    np.testing.assert_allclose(generalised.rates, ordinary.rates, rtol=1e-10)
    np.testing.assert_allclose(generalised.rates_covariance, ordinary.rates_covariance, rtol=1e-10)


def test_generalised_is_never_worse_than_ordinary() -> None:
    """The covariance of ordinary least squares exceeds that of the best linear unbiased estimate."""
    means = make_means(60.0, 50.429)
    ordinary = estimate(means, noise=NOISE, weights="ordinary")
    generalised = estimate(means, noise=NOISE, weights="generalised")
    gain = np.linalg.eigvalsh(ordinary.rates_covariance - generalised.rates_covariance)
    assert gain.min() > -1e-9 * gain.max()
    assert generalised.azimuth_sd < 0.95 * ordinary.azimuth_sd


def test_without_a_noise_model_the_residuals_give_the_errors() -> None:
    """The textbook covariance, residual sum over degrees of freedom, and Student's t."""
    means = make_means(330.0, 49.0)
    rng = np.random.default_rng(8)
    means = means.with_rate(means.rate[:, 0] + 0.2 * DPH * rng.standard_normal(8))
    fix = estimate(means)
    design = np.column_stack([sensitivity(means.azimuth, means.elevation, means.tilt)[:, 0], np.ones(8)])
    solution, squares, *_ = np.linalg.lstsq(design, means.rate[:, 0], rcond=None)
    expected = np.linalg.inv(design.T @ design)[:3, :3] * squares / 4.0
    np.testing.assert_allclose(fix.rates, solution[:3], rtol=1e-9)
    np.testing.assert_allclose(fix.rates_covariance, expected, rtol=1e-8, atol=1e-25)
    assert fix.sd_dof == fix.dof == 4
    assert fix.coverage_factor(0.95) == pytest.approx(2.776, abs=1e-3)


def test_a_known_latitude_stands_in_for_the_missing_vertical() -> None:
    """Four level positions on a tilted pedestal give the azimuth, and the scale factor if the latitude is known."""
    tilt = (0.01, -0.02)
    means = make_means(111.0, 60.0, positions=FOUR, tilt=tilt, scale_factor=1.02)
    exact = estimate(means, noise=NOISE, known=Known(latitude=math.radians(60.0), scale_factor=1.02))
    assert azimuth_error_deg(exact, 111.0) == pytest.approx(0.0, abs=1e-6)
    free = estimate(means, noise=NOISE, known=Known(latitude=math.radians(60.0)))
    assert free.scale_factor == pytest.approx(1.02, rel=1e-3)
    assert free.latitude == math.radians(60.0)
    blind = estimate(means, noise=NOISE)
    assert blind.latitude is None
    assert "vertical" in blind.latitude_reason
    assert abs(azimuth_error_deg(blind, 111.0)) < 3.0 * math.degrees(blind.azimuth_sd)
    assert math.degrees(blind.azimuth_sd) > 0.5  # the vertical rate may be anything, and the pedestal leans


def test_small_elevations_measure_the_vertical_as_well_as_they_can() -> None:
    """Elevations of a degree give a rough latitude and hardly spoil the azimuth; of an arc minute, no latitude."""
    signs = (1, -1, -1, 1, 1, 1, -1, -1)
    fixes = []
    for size in (1.0, 1.0 / 60.0):
        uneven = tuple((azimuth, size * sign) for (azimuth, _), sign in zip(FOUR * 2, signs, strict=True))
        fixes.append(estimate(make_means(111.0, 60.0, positions=uneven), noise=NOISE))
    level = estimate(make_means(111.0, 60.0, positions=FOUR * 2), noise=NOISE)
    assert latitude_deg(fixes[0]) == pytest.approx(60.0, abs=1e-6)
    assert fixes[0].latitude_sd is not None
    assert math.degrees(fixes[0].latitude_sd) > 1.0
    assert fixes[0].azimuth_sd < 1.5 * level.azimuth_sd
    assert fixes[1].latitude is None
    assert abs(azimuth_error_deg(fixes[1], 111.0)) < 3.0 * math.degrees(fixes[1].azimuth_sd)


def test_what_is_known_narrows_what_is_not() -> None:
    """A known scale factor improves the latitude, a known latitude the scale factor, and each by its own sd."""
    means = make_means(70.0, -40.0)
    free = estimate(means, noise=NOISE)
    assert free.latitude_sd is not None
    assert free.scale_factor_sd is not None
    with_scale = estimate(means, noise=NOISE, known=Known(scale_factor=1.0))
    half_known = estimate(means, noise=NOISE, known=Known(scale_factor=1.0, scale_factor_sd=free.scale_factor_sd))
    with_latitude = estimate(means, noise=NOISE, known=Known(latitude=math.radians(-40.0), latitude_sd=1e-6))
    assert with_scale.latitude_sd is not None
    assert half_known.latitude_sd is not None
    assert half_known.scale_factor_sd == pytest.approx(free.scale_factor_sd / math.sqrt(2.0), rel=1e-6)
    assert with_scale.latitude_sd <= half_known.latitude_sd <= free.latitude_sd
    assert with_scale.scale_factor_sd == 0.0
    assert with_latitude.latitude_sd == pytest.approx(1e-6, rel=1e-3)
    for fix in (with_scale, half_known, with_latitude):
        assert latitude_deg(fix) == pytest.approx(-40.0, abs=1e-6)
        assert azimuth_error_deg(fix, 70.0) == pytest.approx(0.0, abs=1e-6)


def test_with_the_vertical_spoilt_the_horizontal_rate_gives_the_latitude() -> None:
    """With a wholly uncertain acceleration-sensitive drift rate a known scale factor still yields the latitude."""
    means = make_means(70.0, 50.0, d_g_dph=3.0)
    known = Known(scale_factor=1.0, acceleration_sensitive_drift_rate_sd=100.0 * DPH)
    assert latitude_deg(estimate(means, noise=NOISE, known=known)) == pytest.approx(50.0, abs=0.02)


def test_three_axes_share_one_earth() -> None:
    """Three axes on the head, each with its own bias, fix azimuth and latitude from two level positions."""
    truth = math.radians(200.0), math.radians(-25.0)
    azimuth, elevation, tilt = np.radians([10.0, 190.0, 10.0]), np.zeros(3), np.full((3, 2), 0.01)
    columns = sensitivity(azimuth, elevation, tilt, n_axes=3)
    forward = make_means(200.0, -25.0, positions=((10, 0), (190, 0), (10, 0)), tilt=(0.01, 0.01))
    nev = np.array([math.cos(truth[1]) * f(truth[0]) for f in (math.cos, math.sin)] + [math.sin(truth[1])])
    rate = columns @ nev * OMEGA_DPH * DPH + np.array([38.0, -5.0, 0.0]) * DPH
    np.testing.assert_allclose(rate[:, 0], forward.rate[:, 0], rtol=1e-12)
    means = replaced(forward, rate=rate)
    known = Known(latitude=truth[1], scale_factor=1.0)
    fix = estimate(means, noise=NOISE, known=known, weights="generalised")
    assert azimuth_error_deg(fix, 200.0) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(np.array(fix.bias[:2]) / DPH, [38.0, -5.0], atol=1e-6)
    assert fix.residuals.shape == (3, 3)


def test_three_axes_agree_with_an_attitude_from_two_vectors() -> None:
    """The earth rate and the vertical seen in the head's axes, aligned with the true ones, give the same azimuth."""
    azimuth, elevation = np.radians([20.0, 200.0, 110.0]), np.radians([10.0, -15.0, 40.0])
    truth = OMEGA_DPH * DPH * np.array([math.cos(1.0), 0.0, -math.sin(1.0)])
    head_to_north = Rotation.from_euler("ZY", np.column_stack([azimuth + 2.5, elevation]))
    means = RateMeans(
        start=[0.0, 20.0, 40.0],
        duration=[10.0] * 3,
        rate=head_to_north.inv().apply(truth) + np.array([1.0, 2.0, -3.0]) * DPH,
        azimuth=azimuth,
        elevation=elevation,
    )
    fix = estimate(means, noise=NOISE, weights="generalised")
    seen = [(means.rate[0] - np.array(fix.bias)) / np.linalg.norm(truth), head_to_north[0].inv().apply([0.0, 0.0, 1.0])]
    attitude, _ = Rotation.align_vectors([truth / np.linalg.norm(truth), [0.0, 0.0, 1.0]], seen)
    forward = attitude.apply([1.0, 0.0, 0.0])
    assert fix.azimuth == pytest.approx(math.atan2(forward[1], forward[0]) - azimuth[0], abs=1e-9)
    assert fix.azimuth == pytest.approx(2.5, abs=1e-9)
    assert fix.latitude == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("positions", "drift", "reason"),
    [
        ((U1, U3, U1), "constant", "along stage azimuth 90 deg"),
        ((U2, U4, U2), "constant", "along stage azimuth 0 deg"),
        ((U5, U6, U5, U6), "constant", "along stage azimuth 0 deg"),
        ((U1, U2), "constant", "cannot determine"),
        ((U1, U2, U3), "linear", "cannot determine"),
        ((U1, U1, U2, U2, U3, U3), "pairs", "along stage azimuth"),
    ],
)
def test_what_the_positions_cannot_determine_is_named(
    positions: Sequence[tuple[float, float]], drift: Drift, reason: str
) -> None:
    """Missing positions give a sentence that names the missing quantity, not a number."""
    with pytest.raises(EstimateError, match=reason):
        estimate(make_means(30.0, 50.0, positions=positions), noise=NOISE, drift=drift)


def test_a_fit_without_residuals_needs_a_noise_model() -> None:
    """Three level positions give an azimuth with a noise model, and without one a reason."""
    means = make_means(30.0, 50.0, positions=(U1, U2, U3))
    assert azimuth_error_deg(estimate(means, noise=NOISE), 30.0) == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(EstimateError, match="no residual"):
        estimate(means)


@pytest.mark.parametrize("latitude", [90.0, -89.9])
def test_near_a_pole_there_is_no_azimuth_and_it_says_so(latitude: float) -> None:
    """Where the horizontal earth rate drowns in its noise the reason is named."""
    with pytest.raises(EstimateError, match="not distinguishable from zero"):
        estimate(make_means(30.0, latitude), noise=NOISE)


def test_a_known_pole_leaves_no_azimuth_even_if_the_data_show_one() -> None:
    """A latitude of 90 deg on entry contradicts a clear azimuth: refused, never a division by cos(lat)."""
    with pytest.raises(EstimateError, match="not distinguishable from zero"):
        estimate(make_means(30.0, 50.0), noise=NOISE, known=Known(latitude=math.pi / 2.0))


def test_pairs_follow_a_bias_that_no_line_follows() -> None:
    """A warm-up curve of 100 deg/h drowns the earth for a constant bias, and leaves successive dwells' differences."""
    positions = tuple((a + turn, 0) for a in (67, 112, 45, 157, 10, 80) for turn in (0, 180))
    means = make_means(20.0, 49.0, positions=positions, dwell=2.5, turn=4.0)
    means = means.with_rate(means.rate[:, 0] + 100.0 * DPH * np.repeat(1.0 - np.exp(-np.arange(6) / 2.0), 2))
    assert azimuth_error_deg(estimate(means, drift="pairs"), 20.0) == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(EstimateError, match="not distinguishable from zero"):
        estimate(means, drift="constant")


def test_improbable_residuals_widen_the_errors_and_are_reported() -> None:
    """Twice the noise that the model tells: the Birge ratio doubles the sd, and the residual check fails."""
    clean = make_means(30.0, 50.0, mean=2.0)
    drawn = draw_noise(np.random.default_rng(4), clean, 1, **TVG43)[0]
    means = clean.with_rate(clean.rate[:, 0] + drawn)
    half = NoiseModel.from_field_units(**{name: value / 2.0 for name, value in TVG43.items()})
    right, wrong = (estimate(means, noise=noise, weights="generalised") for noise in (NOISE, half))
    assert right.rescaled_by == 1.0
    assert failed(right) == []
    assert wrong.rescaled_by == pytest.approx(2.0, rel=0.15)
    assert wrong.azimuth_sd == pytest.approx(right.azimuth_sd, rel=0.15)
    assert failed(wrong) == ["residuals"]
    assert wrong.trustworthy  # the wider interval holds
    double = NoiseModel.from_field_units(**{name: value * 2.0 for name, value in TVG43.items()})
    assert failed(estimate(means, noise=double, weights="generalised")) == ["residuals"]


@pytest.mark.parametrize(
    ("dwell", "name"), [(7, "repeated positions"), (5, "pair sums"), (6, "pair sums"), (4, "repeated positions")]
)
def test_a_dwell_that_was_disturbed_fails_the_check_that_can_see_it(dwell: int, name: str) -> None:
    """One deg/h too much in one dwell is noticed by the check whose positions it enters."""
    means = make_means(30.0, 50.0)
    rate = means.rate[:, 0].copy()
    rate[dwell] += 1.0 * DPH
    assert name in failed(estimate(means.with_rate(rate), noise=NOISE, drift="constant"))
    good = estimate(
        means.with_rate(means.rate[:, 0] + draw_noise(np.random.default_rng(1), means, 1, **TVG43)[0]), noise=NOISE
    )
    assert failed(good) == []


def test_a_wrong_entry_is_contradicted_by_the_data() -> None:
    """A known latitude or scale factor that the data deny fails its check, the right one passes."""
    means = make_means(30.0, 50.0)
    drawn = draw_noise(np.random.default_rng(3), means, 1, **TVG43)[0]
    means = means.with_rate(means.rate[:, 0] + drawn)
    right = Known(latitude=math.radians(50.0), scale_factor=1.0)
    assert failed(estimate(means, noise=NOISE, known=right)) == []
    for wrong in (replace(right, latitude=math.radians(52.0)), replace(right, scale_factor=1.05)):
        fix = estimate(means, noise=NOISE, known=wrong)
        names = failed(fix)
        assert not fix.trustworthy
        assert names == (["latitude"] if wrong.latitude != right.latitude else ["scale factor"])


def test_without_a_vertical_plane_the_horizontal_rate_judges_the_latitude_entered() -> None:
    """The right entry passes; 10 deg off, or a scale factor 5 % off, is caught unless it was said to be as unsure."""
    rng = np.random.default_rng(12)
    means = make_means(75.0, 50.0, positions=FOUR, scale_factor=1.02)
    means = replaced(means, rate=means.rate + draw_noise(rng, means, 1, **TVG43).T)
    right = Known(latitude=math.radians(50.0), scale_factor=1.02)
    fix = estimate(means, noise=NOISE, known=right)
    assert fix.trustworthy
    assert "earth rate" in [check.name for check in fix.checks]
    for wrong in (replace(right, latitude=math.radians(60.0)), replace(right, scale_factor=1.07)):
        assert not estimate(means, noise=NOISE, known=wrong).trustworthy
        assert failed(estimate(means, noise=NOISE, known=wrong)) == ["earth rate"]
        unsure = replace(wrong, latitude_sd=math.radians(5.0), scale_factor_sd=0.03)
        assert estimate(means, noise=NOISE, known=unsure).trustworthy
    for lacking in (replace(right, latitude=None), replace(right, scale_factor=None)):
        assert "earth rate" not in [check.name for check in estimate(means, noise=NOISE, known=lacking).checks]
    sentence = next(c.sentence for c in estimate(means, noise=NOISE, known=wrong).checks if c.name == "earth rate")
    assert "differs by -0.4" in sentence
    assert "deg/h" in sentence


def test_the_limit_of_the_earth_rate_holds_what_the_noise_and_the_entries_bring() -> None:
    """Standard deviation by first principles: entries alone, with no noise to speak of."""
    means = make_means(0.0, 50.0, positions=FOUR)
    known = Known(latitude=math.radians(50.0), latitude_sd=0.001, scale_factor=1.0, scale_factor_sd=0.002)
    fix = estimate(means, noise=NoiseModel(angle_white_noise=1e-12), known=known)
    (check,) = (each for each in fix.checks if each.name == "earth rate")
    expected = OMEGA_DPH * math.hypot(0.002 * math.cos(math.radians(50.0)), 0.001 * math.sin(math.radians(50.0)))
    assert check.sd / DPH == pytest.approx(expected, rel=1e-3)
    assert check.limit / check.sd == pytest.approx(3.29, abs=0.01)


def test_the_acceleration_sensitive_drift_shifts_the_latitude_as_published() -> None:
    """Left out, 3 deg/h/g turn 50.429 deg into some 56 deg, the published error; taken out, the latitude is right."""
    means = make_means(18.887, 50.429, d_g_dph=3.0)
    true = math.radians(50.429)
    wrong = math.degrees(math.atan2(OMEGA_DPH * math.sin(true) + 3.0, OMEGA_DPH * math.cos(true)))
    assert latitude_deg(estimate(means, noise=NOISE)) == pytest.approx(wrong, abs=1e-6)
    known = Known(acceleration_sensitive_drift_rate=3.0 * DPH, acceleration_sensitive_drift_rate_sd=0.3 * DPH)
    fix = estimate(means, noise=NOISE, known=known)
    assert latitude_deg(fix) == pytest.approx(50.429, abs=1e-6)
    assert fix.latitude_sd is not None
    assert math.degrees(fix.latitude_sd) == pytest.approx(
        0.3 * math.cos(math.radians(50.429)) / OMEGA_DPH * 57.3, rel=0.02
    )


@pytest.mark.parametrize(
    "change", [{"latitude": 2.0}, {"latitude": float("nan")}, {"scale_factor": 0.0}, {"tilt_sd": -1.0}]
)
def test_known_values_must_be_possible(change: dict[str, float]) -> None:
    """What cannot be is refused by name."""
    with pytest.raises(ValueError, match=next(iter(change))):
        Known(**change)


def test_generalised_weights_ask_for_a_noise_model() -> None:
    """A caller who forgets the model is told."""
    with pytest.raises(ValueError, match="noise model"):
        estimate(make_means(0.0, 0.0), weights="generalised")


def test_a_plan_of_many_short_dwells_is_one_more_order() -> None:
    """Drift-balanced repetitions of four positions reach a smaller sd in the same time than two-minute dwells."""
    short = make_means(45.0, 50.0, positions=FOUR * 8, dwell=20.0, turn=8.0, mean=5.0)
    paper = make_means(45.0, 50.0, positions=SIX, dwell=120.0, turn=10.0, mean=5.0)
    sds = [estimate(m, noise=NOISE, weights="generalised").azimuth_sd for m in (short, paper)]
    assert sds[0] < 0.75 * sds[1]
