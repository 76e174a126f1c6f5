"""The uncertainty budget: it adds up to what the fix states, and every line is what that error alone would do."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulated_means import DPH, SIX, TVG43, U1, U2, U3, U4, draw_noise, make_means

from northfinder.estimation import Fix, Known, NoiseModel, RateMeans, estimate
from northfinder.estimation.budget import Budget, Contribution, Declared, declared_variance, error_budget
from northfinder.estimation.propagation import MANY
from northfinder.units import ARCSEC

NOISE = NoiseModel.from_field_units(**TVG43)
LATITUDE = math.radians(50.429)
UNSURE = Known(
    scale_factor=1.0, scale_factor_sd=0.004, acceleration_sensitive_drift_rate=3.0 * DPH,
    acceleration_sensitive_drift_rate_sd=0.05 * DPH, tilt_sd=60.0 * ARCSEC,
)  # fmt: skip
AT_LATITUDE = Known(latitude=LATITUDE, latitude_sd=math.radians(0.1), tilt_sd=60.0 * ARCSEC)
GLS: dict[str, Any] = {"noise": NOISE, "weights": "generalised"}
DECLARED = Declared(stage_angle_sd=100.0 * ARCSEC, misalignment_sd=200.0 * ARCSEC)


def six(azimuth_deg: float = 33.0, **changes: Any) -> RateMeans:  # noqa: ANN401  # as make_means takes them
    """Means of the six positions with an acceleration-sensitive drift."""
    given = {"d_g_dph": 3.0, "mean": 5.0, "dwell": 30.0} | changes
    return make_means(azimuth_deg, 50.429, **given)


def noisy(means: RateMeans, seed: int = 5) -> RateMeans:
    """Return the means with one draw of the gyro's noise."""
    return means.with_rate(means.rate[:, 0] + draw_noise(np.random.default_rng(seed), means, 1, **TVG43)[0])


def line(budget: Budget, quantity: str) -> Contribution:
    """Return the line of that quantity."""
    return next(each for each in budget.contributions if each.quantity == quantity)


def both(fix: Fix) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Azimuth and latitude of a fix, rad."""
    return np.array([fix.azimuth, fix.latitude or 0.0])


@pytest.mark.parametrize(
    ("positions", "known", "how"),
    [
        ("six", UNSURE, GLS),
        ("six", AT_LATITUDE, GLS),
        ("six", Known(), GLS),
        ("six", UNSURE, {"noise": NOISE}),
        ("six", UNSURE, {"noise": None, "drift": "linear"}),
        ("four", AT_LATITUDE, GLS),
        ("four", Known(tilt_sd=0.002), GLS),
        ("four", AT_LATITUDE, {"noise": NOISE, "drift": "linear"}),
    ],
)
def test_the_budget_adds_up_to_the_stated_standard_deviations(
    positions: str, known: Known, how: dict[str, Any]
) -> None:
    """Root sum square of the lines, found apart from the estimator's own sum, equals the sd of azimuth and latitude."""
    tilted = {"tilt": (0.01, -0.02)}  # where V is not measured its assumed value then matters
    changes: dict[str, Any] = tilted if positions == "six" else tilted | {"positions": (U1, U2, U3, U4, U1)}
    means = noisy(six(**changes))
    means = means if how.get("weights") else means.per_dwell()
    fix = estimate(means, known=known, **how)
    budget = error_budget(means, fix, known=known, **{"noise": None} | how)
    assert budget.azimuth_sd == pytest.approx(fix.azimuth_sd, rel=1e-5)
    assert budget.latitude_sd == pytest.approx(fix.latitude_sd or 0.0, rel=1e-5, abs=1e-15)
    shares = [each.azimuth for each in budget.contributions]
    assert shares == sorted(shares, reverse=True)
    assert sum(share > 0.0 for share in shares) >= (2 if how["noise"] is None else 3)


def test_a_noise_model_that_does_not_fit_widens_its_own_lines_alone() -> None:
    """The Birge ratio multiplies the noise, and the sum still equals the statement."""
    half = NoiseModel(**{name: 0.4 * getattr(NOISE, name) for name in NOISE.__slots__})
    means = noisy(six())
    fix = estimate(means, known=UNSURE, noise=half, weights="generalised")
    assert fix.rescaled_by > 1.5
    budget = error_budget(means, fix, known=UNSURE, noise=half, weights="generalised")
    assert budget.azimuth_sd == pytest.approx(fix.azimuth_sd, rel=1e-5)
    assert line(budget, "tilt").sd == UNSURE.tilt_sd


@pytest.mark.parametrize("kind", list(TVG43))
def test_each_kind_of_noise_scatters_the_fix_as_its_line_says(kind: str) -> None:
    """Drawn alone and weighted for all kinds together, each gives the rms error of its line, within 4 sampling sd."""
    n_runs = 150
    means = six(dwell=60.0, mean=10.0)
    fix = estimate(means, **GLS)
    names = {"angle_white_noise_dph_s": "angle white noise", "angle_random_walk_deg_per_sqrt_h": "angle random walk"}
    names |= {"bias_instability_dph": "bias instability", "rate_random_walk_dph_per_sqrt_h": "rate random walk"}
    stated = line(error_budget(means, fix, known=Known(), **GLS), names[kind])
    drawn = draw_noise(np.random.default_rng(11), means, n_runs, sample_rate=2.0, **{kind: TVG43[kind]})
    errors = [both(estimate(means.with_rate(means.rate[:, 0] + noise), **GLS)) - both(fix) for noise in drawn]
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms / [stated.azimuth, stated.latitude] == pytest.approx(1.0, abs=4.0 / math.sqrt(2.0 * n_runs))


@pytest.mark.parametrize("azimuth_deg", [33.0, 200.0])
def test_known_quantities_act_as_their_lines_say(azimuth_deg: float) -> None:
    """Moving a known value or the tilt by its sd moves the fix by the contribution stated for it."""
    known = replace(UNSURE, latitude=LATITUDE, latitude_sd=math.radians(0.2))
    means = six(azimuth_deg)
    fix = estimate(means, known=known, **GLS)
    budget = error_budget(means, fix, known=known, **GLS)
    moves = {
        "latitude entry": replace(known, latitude=LATITUDE + known.latitude_sd),
        "scale factor": replace(known, scale_factor=1.0 + known.scale_factor_sd),
        "acceleration-sensitive drift rate": replace(known, acceleration_sensitive_drift_rate=3.05 * DPH),
    }
    for quantity, moved in moves.items():
        change = np.abs(both(estimate(means, known=moved, **GLS)) - both(fix))
        stated = line(budget, quantity)
        assert change == pytest.approx([stated.azimuth, stated.latitude], rel=0.02, abs=1e-9), quantity


def test_a_tilt_acts_as_its_line_says() -> None:
    """Leaning of the axis that the sensors do not show moves the fix by the contribution stated for it."""
    known = Known(tilt_sd=60.0 * ARCSEC)
    means = six(d_g_dph=0.0)
    fix = estimate(means, known=known, **GLS)
    leaning = []
    for tilt in ([known.tilt_sd, 0.0], [0.0, known.tilt_sd]):
        means.tilt[:] = tilt
        leaning.append(both(estimate(means, known=known, **GLS)) - both(fix))
    means.tilt[:] = 0.0
    stated = line(error_budget(means, fix, known=known, **GLS), "tilt")
    assert np.linalg.norm(leaning, axis=0) == pytest.approx([stated.azimuth, stated.latitude], rel=0.01)


def test_stage_angles_act_as_their_line_says() -> None:
    """An error of the angles of one position after the other moves the fix by what the line takes them for."""
    means = six()
    known = replace(UNSURE, tilt_sd=0.0)
    fix = estimate(means, known=known, **GLS)
    budget = error_budget(means, fix, known=known, **GLS, declared=DECLARED)
    moved = []
    for angle in ("azimuth", "elevation"):
        for azimuth, elevation in {tuple(row) for row in np.column_stack([means.azimuth, means.elevation]).tolist()}:
            wrong = six()
            here = (wrong.azimuth == azimuth) & (wrong.elevation == elevation)
            getattr(wrong, angle)[here] += DECLARED.stage_angle_sd
            moved.append(both(estimate(wrong, known=known, **GLS)) - both(fix))
    stated = line(budget, "stage angle")
    assert np.linalg.norm(moved, axis=0) == pytest.approx([stated.azimuth, stated.latitude], rel=0.01)


def test_a_misalignment_acts_as_its_line_says() -> None:
    """An input axis that leans sideways or upward, by plain vectors, moves the fix as stated."""
    lean = math.degrees(DECLARED.misalignment_sd)
    sideways = [(a + lean, e) if e == 0 else (90, e - math.copysign(lean, e)) for a, e in SIX]
    upward = [(a, lean) if e == 0 else (180 if e > 0 else 0, e - math.copysign(lean, e)) for a, e in SIX]
    means, known = six(), replace(UNSURE, tilt_sd=0.0)
    fix = estimate(means, known=known, **GLS)
    moved = []
    for positions in (sideways, upward):
        leaning = means.with_rate(six(positions=positions).rate)
        moved.append(both(estimate(leaning, known=known, **GLS)) - both(fix))
    stated = line(error_budget(means, fix, known=known, **GLS, declared=DECLARED), "input axis misalignment")
    assert np.linalg.norm(moved, axis=0) == pytest.approx([stated.azimuth, stated.latitude], rel=0.01)
    calibrated = replace(DECLARED, azimuth_offset_sd=30.0 * ARCSEC)
    budget = error_budget(means, fix, known=known, **GLS, declared=calibrated)
    assert line(budget, "input axis misalignment").azimuth == 0.0
    assert line(budget, "input axis misalignment").latitude == stated.latitude
    assert line(budget, "azimuth offset").azimuth == pytest.approx(30.0 * ARCSEC)


def test_declared_uncertainties_are_what_the_estimator_lacks() -> None:
    """What is to be added after the estimator brings its statement to the sum of the whole budget."""
    means = noisy(six())
    declared = replace(DECLARED, azimuth_offset_sd=0.001, scale_drift_correlation=-0.7)
    known = replace(UNSURE, scale_factor_sd=0.02)
    fix = estimate(means, known=known, **GLS)
    added = declared_variance(means, fix, known=known, drift="constant", declared=declared, **GLS)
    budget = error_budget(means, fix, known=known, declared=declared, **GLS)
    assert budget.azimuth_sd**2 == pytest.approx(fix.azimuth_sd**2 + added[0], rel=1e-5)
    assert budget.latitude_sd**2 == pytest.approx((fix.latitude_sd or 0.0) ** 2 + added[1], rel=1e-5)
    nothing = declared_variance(means, fix, known=known, drift="constant", declared=Declared(), **GLS)
    assert not nothing.any()


def test_the_budget_of_a_long_measurement_is_near() -> None:
    """Of more means than it can propagate in a moment, longer ones stand for all: the sum is right within 3 %."""
    means = six(positions=SIX * 24, dwell=30.0, mean=1.0)
    assert means.n > MANY
    fix = estimate(means, known=UNSURE, **GLS)
    budget = error_budget(means, fix, known=UNSURE, **GLS)
    assert budget.azimuth_sd == pytest.approx(fix.azimuth_sd, rel=0.03)
    assert budget.latitude_sd == pytest.approx(fix.latitude_sd or 0.0, rel=0.03)


def test_three_axes_add_up_too() -> None:
    """With three axes each has noise and misalignments of its own, and the budget equals the statement."""
    one = [make_means(77.0, -33.0, positions=p, dwell=20.0, mean=5.0) for p in ((U1, U2, U3, U4), (U2, U3, U4, U1))]
    down = -np.full(one[0].n, 15.041067 * math.sin(math.radians(-33.0))) * DPH
    rates = np.column_stack([one[0].rate[:, 0], one[1].rate[:, 0], down])
    means = one[0].with_rate(rates)
    known = Known(latitude=math.radians(-33.0), latitude_sd=0.01)
    fix = estimate(means, known=known, **GLS)
    budget = error_budget(means, fix, known=known, declared=DECLARED, **GLS)
    added = declared_variance(means, fix, known=known, drift="constant", declared=DECLARED, **GLS)
    assert budget.azimuth_sd == pytest.approx(math.hypot(fix.azimuth_sd, math.sqrt(added[0])), rel=1e-5)
    assert 0.5 < line(budget, "input axis misalignment").azimuth / DECLARED.misalignment_sd < 1.1
