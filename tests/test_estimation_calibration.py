"""Constants from measurements at known places: right, as sure as stated, and the right model of the vertical plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated_means import DPH, OMEGA_DPH, TVG43, draw_noise, make_means

from northfinder.errors import EstimateError
from northfinder.estimation import Fix, Known, NoiseModel, RateMeans, estimate, solve_closed_form
from northfinder.estimation.budget import Declared, declared_variance
from northfinder.estimation.calibration import Constants, Reading, calibrate, with_ratio

Array = NDArray[np.float64]

NOISE = NoiseModel.from_field_units(**TVG43)
SCALE, DRIFT_DPH, AZIMUTH_DEG = 1.021, 3.0, 33.0
KYIV = 50.429
NOTHING = np.zeros((3, 3))


def means_at(latitude_deg: float, *, d_g_dph: float = DRIFT_DPH) -> RateMeans:
    """Return noise-free means of the six positions of the instrument to be calibrated."""
    return make_means(AZIMUTH_DEG, latitude_deg, mean=24.0, scale_factor=SCALE, d_g_dph=d_g_dph)


def fixes_at(latitude_deg: float, n: int, seed: int, *, d_g_dph: float = DRIFT_DPH) -> list[Fix]:
    """Return `n` fixes with noise and nothing known."""
    return [estimate(each, noise=NOISE, weights="generalised") for each in noisy_at(latitude_deg, n, seed, d_g_dph)]


def noisy_at(latitude_deg: float, n: int, seed: int, d_g_dph: float = DRIFT_DPH) -> list[RateMeans]:
    """Return `n` draws of means with noise."""
    means = means_at(latitude_deg, d_g_dph=d_g_dph)
    drawn = draw_noise(np.random.default_rng(seed), means, n, sample_rate=1.0, **TVG43)
    return [means.with_rate(means.rate[:, 0] + noise) for noise in drawn]


def reading(fix: Fix, latitude_deg: float, *, common: Array = NOTHING, offset_deg: float = 0.0) -> Reading:
    """Return a fix as a reading; the line to be measured lies `offset_deg` before stage azimuth zero."""
    return Reading(
        rates=fix.rates,
        covariance=fix.rates_covariance,
        common=common,
        latitude=math.radians(latitude_deg),
        azimuth=math.radians(AZIMUTH_DEG - offset_deg),
    )


def normalised(values: Sequence[float], sds: Sequence[float], truth: float) -> Array:
    """Errors over their stated standard deviations."""
    return np.asarray((np.asarray(values) - truth) / np.asarray(sds))


def expect_honest(ratio: Array) -> None:
    """Assert that normalised errors have mean 0 and rms 1, within 4 sampling standard deviations."""
    assert abs(float(np.mean(ratio))) < 4.0 / math.sqrt(ratio.size)
    assert abs(float(np.sqrt(np.mean(ratio**2))) - 1.0) < 4.0 / math.sqrt(2.0 * ratio.size)


def true_ratio(latitude_deg: float) -> float:
    """Return the k that the drift rate amounts to at one latitude."""
    vertical = SCALE * OMEGA_DPH * math.sin(math.radians(latitude_deg))
    return vertical / (vertical + DRIFT_DPH)


def test_constants_without_noise_are_exact() -> None:
    """Scale factor, drift rate, ratio and azimuth offset come out as put in, also across the 0 of azimuth."""
    fix = estimate(means_at(KYIV), noise=NOISE, weights="generalised")
    found = calibrate([reading(fix, KYIV, offset_deg=200.0)])
    assert found.acceleration_sensitive.first == pytest.approx(SCALE, rel=1e-6)
    assert found.acceleration_sensitive.second == pytest.approx(DRIFT_DPH * DPH, rel=1e-5)
    assert found.ratio is not None
    assert found.ratio.second == pytest.approx(true_ratio(KYIV), rel=1e-5)
    assert found.ratio.second == pytest.approx(0.797, abs=0.001)  # the published figure
    assert found.azimuth_offset is not None
    assert math.remainder(found.azimuth_offset - math.radians(200.0), 2.0 * math.pi) == pytest.approx(0.0, abs=1e-6)
    assert found.supported is None


def test_constants_scatter_as_stated() -> None:
    """Over 150 calibrations of three records each, every constant errs by its standard deviation."""
    fixes = fixes_at(KYIV, 450, seed=1)
    found = [calibrate([reading(fix, KYIV, offset_deg=7.0) for fix in fixes[i : i + 3]]) for i in range(0, 450, 3)]
    drifts = [each.acceleration_sensitive for each in found]
    expect_honest(normalised([fit.first for fit in drifts], [fit.first_sd for fit in drifts], SCALE))
    expect_honest(normalised([fit.second for fit in drifts], [fit.second_sd for fit in drifts], DRIFT_DPH * DPH))
    ratios = [each.ratio for each in found if each.ratio is not None]
    expect_honest(normalised([fit.second for fit in ratios], [fit.second_sd for fit in ratios], true_ratio(KYIV)))
    offsets = [each.azimuth_offset or 0.0 for each in found]
    expect_honest(normalised(offsets, [each.azimuth_offset_sd or 0.0 for each in found], math.radians(7.0)))
    correlation = np.corrcoef([fit.first for fit in drifts], [fit.second for fit in drifts])[0, 1]
    assert correlation == pytest.approx(drifts[0].correlation, abs=0.15)


def test_several_latitudes_tell_the_models_apart() -> None:
    """Data of a drift rate support that model, data of two scale factors the other, in nearly all of 30 cases."""
    places = (10.0, KYIV, -33.0)
    by_drift = [fixes_at(latitude, 30, seed=i) for i, latitude in enumerate(places)]
    by_planes = [fixes_at(latitude, 30, seed=9 + i, d_g_dph=0.0) for i, latitude in enumerate(places)]
    planes = np.diag([1.0, 1.0, 1.0 / 0.8])

    def supported(case: Sequence[Fix]) -> Constants:
        return calibrate([reading(fix, latitude) for fix, latitude in zip(case, places, strict=True)])

    drifts = [supported(case) for case in zip(*by_drift, strict=True)]
    assert sum(found.supported == "acceleration-sensitive" for found in drifts) >= 28
    assert all((found.ratio.probability or 0.0) < 1e-3 for found in drifts if found.ratio is not None)
    ratios = [
        supported([replace(fix, rates=planes @ fix.rates, rates_covariance=planes @ fix.rates_covariance @ planes)
                   for fix in case])
        for case in zip(*by_planes, strict=True)
    ]  # fmt: skip
    assert sum(found.supported == "ratio" for found in ratios) >= 28
    probabilities = [found.ratio.probability or 0.0 for found in ratios if found.ratio is not None]
    assert 0.3 < np.mean(probabilities) < 0.7


def test_a_ratio_found_at_one_latitude_is_wrong_at_another() -> None:
    """Calibrated at 50.429 and used at 30: k errs by 2.6 deg, the drift rate errs as its standard deviation says."""
    n_runs = 60
    at_home, abroad = fixes_at(KYIV, 4 * n_runs, seed=21), fixes_at(30.0, n_runs, seed=22)
    by_ratio, by_drift, sds = [], [], []
    for run, fix in enumerate(abroad):
        found = calibrate([reading(each, KYIV) for each in at_home[4 * run : 4 * run + 4]])
        assert found.ratio is not None
        k = with_ratio(fix, Known(), ratio=found.ratio.second, ratio_sd=found.ratio.second_sd)
        drift = found.acceleration_sensitive
        vertical = np.array([0.0, 0.0, 1.0])
        cov = fix.rates_covariance + np.outer(vertical, vertical) * drift.second_sd**2
        again = with_ratio(
            replace(fix, rates=fix.rates - drift.second * vertical, rates_covariance=cov),
            Known(), ratio=1.0, ratio_sd=0.0,
        )  # fmt: skip
        by_ratio.append(math.degrees(k.latitude or 0.0) - 30.0)
        by_drift.append(math.degrees(again.latitude or 0.0) - 30.0)
        sds.append(math.degrees(again.latitude_sd or 0.0))
    assert np.mean(by_ratio) == pytest.approx(2.64, abs=4.0 * float(np.std(by_ratio)) / math.sqrt(n_runs))
    assert np.mean(by_ratio) == pytest.approx(2.6, abs=0.1)
    assert max(sds) < 0.3
    expect_honest(np.array(by_drift) / np.array(sds))


def test_scale_factor_and_drift_rate_used_together_are_as_sure_as_stated() -> None:
    """Both are used as known, and they are correlated; only with that counted are the errors as large as stated."""
    n_runs = 100
    at_home, abroad = fixes_at(KYIV, n_runs, seed=31), noisy_at(-10.0, n_runs, seed=32)
    ratios, uncorrelated = [], []
    for home, means in zip(at_home, abroad, strict=True):
        fit = calibrate([reading(home, KYIV)]).acceleration_sensitive
        known = Known(
            scale_factor=fit.first, scale_factor_sd=fit.first_sd,
            acceleration_sensitive_drift_rate=fit.second, acceleration_sensitive_drift_rate_sd=fit.second_sd,
        )  # fmt: skip
        fix = estimate(means, noise=NOISE, known=known, weights="generalised")
        declared = Declared(scale_drift_correlation=fit.correlation)
        added = declared_variance(
            means, fix, noise=NOISE, known=known, drift="constant", weights="generalised", declared=declared
        )
        error = (fix.latitude or 0.0) - math.radians(-10.0)
        ratios.append(error / math.sqrt((fix.latitude_sd or 0.0) ** 2 + added[1]))
        uncorrelated.append(abs(added[1]) / (fix.latitude_sd or 1.0) ** 2)
    expect_honest(np.array(ratios))
    assert min(uncorrelated) > 0.01  # the correlation matters here


def test_the_ratio_is_that_of_the_published_formula() -> None:
    """With equal weights of the first visits, k gives the latitude of (12) exactly."""
    means = make_means(AZIMUTH_DEG, KYIV, scale_factor=SCALE, d_g_dph=DRIFT_DPH)
    first = means.select(np.array([True, True, True, True, False, True, True, False]))
    fix = with_ratio(estimate(first, noise=NOISE), Known(), ratio=0.797, ratio_sd=0.01)
    published = solve_closed_form(means, scale_factor_ratio=0.797)
    assert fix.latitude == pytest.approx(published.latitude, abs=1e-9)
    assert fix.azimuth == pytest.approx(published.azimuth, abs=1e-9)


def test_a_wrong_entry_and_common_errors_do_not_average_out() -> None:
    """Ten records have the statistical sd of one over sqrt(10), but the sd of the latitude and the tilt in full."""
    fix = estimate(means_at(KYIV), noise=NOISE, weights="generalised")
    one, ten = calibrate([reading(fix, KYIV)]), calibrate([reading(fix, KYIV)] * 10)
    assert ten.acceleration_sensitive.second_sd * math.sqrt(10.0) == pytest.approx(one.acceleration_sensitive.second_sd)
    sd = math.radians(0.2)
    unsure = calibrate([reading(fix, KYIV)] * 10, latitude_sd=sd, azimuth_sd=0.01)
    moved = calibrate([reading(fix, KYIV + 0.2)] * 10)
    for wrong, right, stated, alone in zip(
        (moved.acceleration_sensitive.first, moved.acceleration_sensitive.second),
        (one.acceleration_sensitive.first, one.acceleration_sensitive.second),
        (unsure.acceleration_sensitive.first_sd, unsure.acceleration_sensitive.second_sd),
        (ten.acceleration_sensitive.first_sd, ten.acceleration_sensitive.second_sd),
        strict=True,
    ):
        assert math.sqrt(stated**2 - alone**2) == pytest.approx(abs(wrong - right), rel=0.01)
    assert unsure.azimuth_offset_sd == pytest.approx(math.hypot(0.01, ten.azimuth_offset_sd or 0.0))
    common = np.diag([0.0, 0.0, (0.1 * DPH) ** 2])
    tilted = calibrate([reading(fix, KYIV, common=common)] * 10)
    added = tilted.acceleration_sensitive.second_sd**2 - ten.acceleration_sensitive.second_sd**2
    assert math.sqrt(added) == pytest.approx(0.1 * DPH, rel=1e-6)


def test_records_that_disagree_widen_the_statement() -> None:
    """Turn-on changes far beyond the noise multiply the standard deviation by the Birge ratio."""
    fixes = [estimate(means_at(KYIV, d_g_dph=d), noise=NOISE, weights="generalised") for d in (2.0, 3.0, 4.0)]
    found = calibrate([reading(fix, KYIV) for fix in fixes]).acceleration_sensitive
    assert found.second / DPH == pytest.approx(3.0, abs=0.01)
    assert found.second_sd / DPH > 0.3
    assert found.probability is not None
    assert found.probability < 1e-6


def test_nothing_to_calibrate_from_is_said() -> None:
    """No reading is a named reason; on the equator there is no ratio."""
    with pytest.raises(EstimateError, match="no measurement to calibrate from"):
        calibrate([])
    level = estimate(means_at(0.0), noise=NOISE, weights="generalised")
    assert calibrate([reading(level, 0.0)]).ratio is None
