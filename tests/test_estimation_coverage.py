"""The stated standard deviations hold: scatter and coverage over many seeded runs, with bounds from their number."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from simulated_means import DPH, SIX, TVG43, U1, U2, U3, U4, draw_noise, make_means

from northfinder.estimation import Fix, Known, NoiseModel, estimate
from northfinder.estimation.least_squares import Weights
from northfinder.estimation.linear import Drift

NOISE = NoiseModel.from_field_units(**TVG43)
N_RUNS = 200


def consistent(errors: Sequence[float], sds: Sequence[float], factor: float = 1.96, expected: float = 0.95) -> None:
    """Assert that errors over sd have rms 1, and that `factor` sd cover the expected part, within 4 sampling sd."""
    ratio = np.asarray(errors) / np.asarray(sds)
    n = ratio.size
    covered = float(np.mean(np.abs(ratio) < factor))
    assert abs(covered - expected) < 4.0 * math.sqrt(expected * (1.0 - expected) / n), covered
    if factor == 1.96:
        assert abs(float(np.sqrt(np.mean(ratio**2))) - 1.0) < 4.0 / math.sqrt(2.0 * n)
        assert abs(float(np.mean(ratio))) < 4.0 / math.sqrt(n)


def azimuth_errors(fixes: Sequence[Fix], azimuth_deg: float) -> list[float]:
    """Errors of the azimuths the short way round, rad."""
    return [math.remainder(fix.azimuth - math.radians(azimuth_deg), 2.0 * math.pi) for fix in fixes]


@pytest.mark.parametrize(
    ("azimuth_deg", "latitude", "weights", "drift"),
    [
        (18.887, 50.429, "ordinary", "constant"),
        (147.0, -65.0, "ordinary", "linear"),
        (270.0, 0.5, "generalised", "constant"),
        (225.0, 80.0, "generalised", "linear"),
    ],
)
def test_errors_are_as_large_as_stated(azimuth_deg: float, latitude: float, weights: Weights, drift: Drift) -> None:
    """Azimuth, latitude and scale factor scatter as stated, in both hemispheres, at the equator and near the pole."""
    means = make_means(azimuth_deg, latitude, positions=SIX, mean=24.0 if weights == "generalised" else None)
    drawn = draw_noise(np.random.default_rng(7), means, N_RUNS, sample_rate=2.0, **TVG43)
    fixes = [
        estimate(means.with_rate(means.rate[:, 0] + noise), noise=NOISE, weights=weights, drift=drift)
        for noise in drawn
    ]
    consistent(azimuth_errors(fixes, azimuth_deg), [fix.azimuth_sd for fix in fixes])
    consistent(
        [(fix.latitude or 0.0) - math.radians(latitude) for fix in fixes], [fix.latitude_sd or 0.0 for fix in fixes]
    )
    consistent([(fix.scale_factor or 0.0) - 1.0 for fix in fixes], [fix.scale_factor_sd or 0.0 for fix in fixes])
    rescaled = sum(fix.rescaled_by > 1.0 for fix in fixes)
    assert rescaled < 0.04 * N_RUNS + 4.0 * math.sqrt(0.04 * N_RUNS)  # two tests, 2 % each


def test_known_quantities_with_errors_of_their_own_keep_the_coverage() -> None:
    """Latitude and scale factor entered with errors of the stated size, four positions and six: azimuth covered."""
    rng = np.random.default_rng(9)
    for positions in ((U1, U2, U3, U4, U1), SIX):
        means = make_means(200.0, 60.0, positions=positions, tilt=(0.0, 0.02), dwell=60.0)
        drawn = draw_noise(rng, means, N_RUNS, sample_rate=2.0, **TVG43)
        fixes = [
            estimate(
                means.with_rate(means.rate[:, 0] + noise),
                noise=NOISE,
                known=Known(
                    latitude=math.radians(60.0) + 0.02 * rng.standard_normal(),
                    latitude_sd=0.02,
                    scale_factor=1.0 + 0.01 * rng.standard_normal(),
                    scale_factor_sd=0.01,
                ),
            )
            for noise in drawn
        ]
        consistent(azimuth_errors(fixes, 200.0), [fix.azimuth_sd for fix in fixes])
        consistent([(fix.latitude or 0) - math.radians(60.0) for fix in fixes], [fix.latitude_sd or 0 for fix in fixes])


def test_student_t_covers_when_the_residuals_give_the_noise() -> None:
    """Without a noise model, with white noise and few degrees of freedom, the t interval covers 95 %."""
    means = make_means(100.0, 30.0, positions=SIX)
    rng = np.random.default_rng(12)
    noisy = [means.with_rate(means.rate[:, 0] + 0.1 * DPH * rng.standard_normal(means.n)) for _ in range(N_RUNS)]
    fixes = [estimate(m) for m in noisy]
    assert fixes[0].coverage_factor() == pytest.approx(2.776, abs=1e-3)
    consistent(azimuth_errors(fixes, 100.0), [fix.azimuth_sd for fix in fixes], factor=fixes[0].coverage_factor())


def test_half_the_noise_in_the_model_still_covers() -> None:
    """With every coefficient half the truth the residuals widen the interval to at least 93 % and the fix says so."""
    means = make_means(45.0, 50.0, positions=SIX, mean=24.0)
    drawn = draw_noise(np.random.default_rng(13), means, N_RUNS, sample_rate=2.0, **TVG43)
    half = NoiseModel.from_field_units(**{name: value / 2.0 for name, value in TVG43.items()})
    fixes = [estimate(means.with_rate(means.rate[:, 0] + noise), noise=half, weights="generalised") for noise in drawn]
    ratio = np.abs(azimuth_errors(fixes, 45.0)) / np.array([fix.azimuth_sd for fix in fixes])
    assert np.mean(ratio < 1.96) > 0.93 - 2.0 * math.sqrt(0.05 / N_RUNS)
    assert np.mean([fix.rescaled_by > 1.5 for fix in fixes]) > 0.95


def test_slow_noise_that_the_model_lacks_shows_between_the_dwells() -> None:
    """The dwell means betray a model that holds the angle noise alone, and the interval still covers."""
    means = make_means(45.0, 50.0, mean=5.0)
    drawn = draw_noise(np.random.default_rng(14), means, 100, sample_rate=2.0, **TVG43)
    fast = {"bias_instability_dph": 0.0, "rate_random_walk_dph_per_sqrt_h": 0.0}
    noise = NoiseModel.from_field_units(**TVG43 | fast)
    fixes = [estimate(means.with_rate(means.rate[:, 0] + x), noise=noise, weights="generalised") for x in drawn]
    failed = [{check.name for check in fix.checks if not check.passed} for fix in fixes]
    assert np.mean(["residuals between dwells" in names for names in failed]) > 0.5
    ratio = np.abs(azimuth_errors(fixes, 45.0)) / np.array([fix.azimuth_sd for fix in fixes])
    covered = float(np.mean(ratio < np.array([fix.coverage_factor() for fix in fixes])))
    assert covered > 0.95 - 3.0 * math.sqrt(0.05 / 100)


def test_azimuth_sd_grows_as_the_secant_of_the_latitude() -> None:
    """From the equator to 80 deg, north and south, the sd of the azimuth times cos(lat) stays the same."""
    means = [make_means(33.0, latitude) for latitude in (0.0, 50.0, -50.0, 80.0, -80.0)]
    sds = [estimate(m, noise=NOISE, weights="generalised").azimuth_sd for m in means]
    flat = [sd * math.cos(math.radians(lat)) for sd, lat in zip(sds, (0.0, 50.0, -50.0, 80.0, -80.0), strict=True)]
    assert flat == pytest.approx([flat[0]] * 5, rel=1e-6)
