"""Allan deviation and noise identification: held against allantools, closed forms, and emulated records."""

from __future__ import annotations

import math
import time

import allantools
import numpy as np
import pytest
from allantools.ci import edf_greenhall
from numpy.typing import NDArray

from northfinder.errors import EstimateError
from northfinder.estimation.allan import (
    _second_difference_covariance,
    allan_curve,
    averaging_factors,
    degrees_of_freedom,
    overlapping_allan_deviation,
)
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.noise_identification import KINDS, Identification, _Bands, _regress, identify
from northfinder.units import DPH
from sim_device.plant.noise import NoiseCoefficients, RateNoise

Array = NDArray[np.float64]

TVG43 = NoiseModel.from_field_units(
    angle_white_noise_dph_s=0.764,
    angle_random_walk_deg_per_sqrt_h=0.003,
    bias_instability_dph=0.06,
    rate_random_walk_dph_per_sqrt_h=0.2,
)
HOURS = 4.0
SAMPLE_RATE = 20.0


def emulated(noise: NoiseModel, seed: int, *, hours: float = HOURS, sample_rate: float = SAMPLE_RATE) -> Array:
    """Return a static record of the emulator's gyro, rounded as on the wire."""
    coefficients = NoiseCoefficients(**{name: getattr(noise, name) for name in KINDS})
    rate = RateNoise(coefficients, sample_rate, np.random.SeedSequence(seed)).read(round(hours * 3600 * sample_rate))
    lsb = DPH / 1024
    return np.asarray(np.round((rate + 38.0 * DPH) / lsb) * lsb)


def of(name: str, identified: Identification) -> tuple[float, float | None, float | None]:
    """Return value, sd and upper bound of one coefficient."""
    found = next(each for each in identified.coefficients if each.name == name)
    return found.value, found.sd, found.upper_bound


def test_deviation_equals_that_of_allantools() -> None:
    """All averaging times of a drifting record agree with an independent implementation to 1e-9."""
    rate = np.cumsum(np.random.default_rng(1).standard_normal(20_001)) + 100.0
    factors = averaging_factors(rate.size)
    _, peer, _, _ = allantools.oadev(rate, rate=8.0, data_type="freq", taus=factors / 8.0)
    np.testing.assert_allclose(overlapping_allan_deviation(rate, factors), peer, rtol=1e-9)
    assert {1, 10, 100, 1000} <= set(factors.tolist())
    assert 0.8 < 3 * factors[-1] / rate.size <= 1.0


def test_averaging_factors_have_limits() -> None:
    """A factor longer than half the record, or a record of two samples, is refused."""
    with pytest.raises(ValueError, match="half of 10 samples"):
        overlapping_allan_deviation(np.arange(10.0), np.array([6]))
    with pytest.raises(EstimateError, match="expected 3 or more"):
        averaging_factors(2)


@pytest.mark.parametrize(
    ("kind", "alpha"),
    [("angle_white_noise", 2), ("angle_random_walk", 0), ("bias_instability", -1), ("rate_random_walk", -2)],
)
def test_degrees_of_freedom_equal_greenhalls_for_each_pure_noise(kind: str, alpha: int) -> None:
    """For one kind of noise they agree with the published algorithm, which is accurate to 1 % at long averaging."""
    for n, factor in ((10_000, 100), (10_000, 1000), (1000, 200)):
        ours = degrees_of_freedom(NoiseModel(**{kind: 1e-6}), n, factor, 0.01)
        assert ours == pytest.approx(edf_greenhall(alpha, 2, factor, n + 1, overlapping=True), rel=0.01)


def test_second_differences_have_the_allan_variance() -> None:
    """Without lag their covariance is ``2 tau^2`` times the Allan variance of the mixed noise model."""
    noise = NoiseModel(angle_random_walk=2e-6, bias_instability=3e-7, rate_random_walk=1e-7)
    for tau in (0.1, 10.0, 1000.0):
        covariance = _second_difference_covariance(noise, np.zeros(1), tau)[0]
        assert covariance == pytest.approx(2.0 * tau**2 * noise.allan_deviation(tau) ** 2, rel=1e-9)


def test_no_noise_has_no_degrees_of_freedom() -> None:
    """A model without noise says nothing of scatter, and is refused."""
    with pytest.raises(ValueError, match="without noise"):
        degrees_of_freedom(NoiseModel(rate_ramp=1.0), 1000, 10, 1.0)


def test_confidence_band_covers_the_expectation() -> None:
    """Over 60 records of mixed noise the 95 % band holds the true deviation 95 times in 100 at each averaging time."""
    n_runs, covered = 60, []
    for seed in range(n_runs):
        curve = allan_curve(emulated(TVG43, seed, hours=0.5, sample_rate=4.0), 4.0, TVG43)
        true = TVG43.allan_deviation(curve.tau)
        covered.append((curve.low < true) & (true < curve.high))
    share = np.mean(covered, axis=0)
    assert np.all(share > 0.95 - 4.0 * math.sqrt(0.95 * 0.05 / n_runs)), share
    assert 0.93 < np.mean(covered) < 0.97


@pytest.fixture(scope="module")
def identifications() -> list[Identification]:
    """Identify 20 seeded records of 4 h."""
    return [identify(emulated(TVG43, seed), SAMPLE_RATE) for seed in range(20)]


@pytest.mark.parametrize("kind", KINDS[:4])
def test_coefficients_of_twenty_records_are_unbiased_within_their_sd(
    identifications: list[Identification], kind: str
) -> None:
    """Mean error, scatter and stated sd agree: 3 sd of the mean of 20, chi-square bounds of 20 at 0.1 %."""
    values, sds, bounds = zip(*(of(kind, each) for each in identifications), strict=True)
    true = getattr(TVG43, kind)
    sd = math.sqrt(np.mean([each**2 for each in sds if each is not None]))
    assert abs(np.mean(values) - true) < 3.0 * sd / math.sqrt(20)
    assert 0.5 < math.sqrt(np.mean((np.array(values) - true) ** 2)) / sd < 1.55
    assert all(bound > true for bound in bounds if bound is not None)
    assert sum(each is not None for each in sds) >= 18


def test_no_ramp_is_found_where_a_random_walk_explains_the_trend(identifications: list[Identification]) -> None:
    """Of 20 records without a ramp at most two show one; else a bound is given."""
    found = [of("rate_ramp", each) for each in identifications]
    assert sum(value > 0.0 for value, _, _ in found) <= 2
    assert all(bound is not None for value, _, bound in found if value == 0.0)


def test_a_ramp_beside_a_random_walk_is_found() -> None:
    """A ramp of 1 deg/h/h is told from a random walk, and leaves the other coefficients alone."""
    ramp = 1.0 * DPH / 3600.0
    noise = NoiseModel(**{name: getattr(TVG43, name) for name in KINDS[:4]} | {"rate_ramp": ramp})
    found = identify(emulated(noise, 7), SAMPLE_RATE)
    for kind in KINDS:
        value, sd, _ = of(kind, found)
        assert sd is not None
        assert abs(value - getattr(noise, kind)) < 3.5 * sd


@pytest.mark.parametrize("kind", KINDS[:4])
def test_a_single_kind_is_not_spread_over_others(kind: str) -> None:
    """From pure noise its coefficient returns within 3.5 sd, and so does the Allan deviation up to 100 s."""
    true = getattr(TVG43, kind)
    rate = RateNoise(NoiseCoefficients(**{kind: true}), 10.0, np.random.SeedSequence(3)).read(36_000)
    found = identify(rate, 10.0)
    value, sd, _ = of(kind, found)
    assert sd is not None
    assert abs(value - true) < 3.5 * sd
    tau = np.geomspace(0.1, 100.0, 20)
    expected = NoiseModel(**{kind: true}).allan_deviation(tau)
    np.testing.assert_allclose(found.noise.allan_deviation(tau), expected, rtol=0.1)
    assert found.model_error == 0.0


def test_angle_white_noise_of_the_ends_is_no_slow_noise() -> None:
    """Over 20 records of pure angle white noise, at most 8 of 80 other coefficients appear: chance gives about 4."""
    n_spurious = 0
    for seed in range(20):
        angle = np.random.default_rng(seed).standard_normal(6001)
        found = identify(np.diff(angle) * 1e-6, 1.0)
        assert of("angle_white_noise", found)[0] == pytest.approx(1e-6, rel=0.05)
        n_spurious += sum(each.observable for each in found.coefficients[1:])
    assert n_spurious <= 8


def test_regressors_cost_three_degrees_of_freedom() -> None:
    """The trend and the two end angles take three of the degrees of freedom, wherever the weights put them."""
    bands = _Bands.of(np.random.default_rng(1).standard_normal(500), 0.5)
    for weights in ([1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 1.0, 0.0], [0.1, 0.0, 0.0, 1.0]):
        residual = _regress(bands, bands.spectra @ np.array(weights))
        assert residual.dof.sum() == pytest.approx(499 - 3, abs=1e-3)


def test_what_is_not_observable_is_zero_with_a_bound() -> None:
    """A minute of white noise says nothing of slow noise: zeros, and bounds that a longer record tightens."""
    noise = NoiseModel(angle_random_walk=TVG43.angle_random_walk)
    short = of("rate_random_walk", identify(emulated(noise, 1, hours=0.02), SAMPLE_RATE))
    longer = of("rate_random_walk", identify(emulated(noise, 1, hours=1.0), SAMPLE_RATE))
    assert short[:2] == longer[:2] == (0.0, None)
    assert short[2] is not None
    assert longer[2] is not None
    assert longer[2] < 0.1 * short[2]


def test_coarse_rounding_of_the_output_adds_its_own_white_noise_only() -> None:
    """Rounding to steps as large as the noise gives ``step^2/12`` more white rate noise and leaves the rest."""
    noise = NoiseModel(angle_random_walk=TVG43.angle_random_walk, bias_instability=TVG43.bias_instability)
    rate = emulated(noise, 5, hours=2.0)
    step = 1.5 * float(np.std(rate))
    found = identify(np.round(rate / step) * step, SAMPLE_RATE)
    expected = math.hypot(noise.angle_random_walk, step / math.sqrt(12.0 * SAMPLE_RATE))
    value, sd, _ = of("angle_random_walk", found)
    assert sd is not None
    assert abs(value - expected) < 3.5 * sd + 0.01 * expected
    value, sd, _ = of("bias_instability", found)
    assert sd is not None
    assert abs(value - noise.bias_instability) < 3.5 * sd


def test_a_filter_in_the_gyro_is_noticed_and_does_not_mislead() -> None:
    """A low-pass filter within the band of the record shows as a model error; slower noise stays right."""
    noise = NoiseModel(angle_random_walk=TVG43.angle_random_walk, bias_instability=TVG43.bias_instability)
    rate = emulated(noise, 9, hours=2.0, sample_rate=10.0)
    filtered = np.convolve(rate, [0.25, 0.5, 0.25], mode="valid")
    found = identify(filtered, 10.0)
    assert found.model_error > 0.05
    tau = np.array([3.0, 10.0, 100.0])
    np.testing.assert_allclose(found.noise.allan_deviation(tau), noise.allan_deviation(tau), rtol=0.15)


@pytest.mark.parametrize(
    ("rate", "message"), [(np.ones(99), "expected 100 s or more"), (np.full(5000, 3.25), "never changes")]
)
def test_a_record_that_shows_no_noise_is_refused(rate: Array, message: str) -> None:
    """Too short, or frozen."""
    with pytest.raises(EstimateError, match=message):
        identify(rate, 1.0)


@pytest.mark.parametrize("sample_rate", [1.0, 100.0])
@pytest.mark.parametrize(
    "name", ["alternating", "sine", "step", "impulse", "ramp", "first", "cosine", "held", "cauchy"]
)
def test_a_curve_without_noise_is_refused_or_fitted(name: str, sample_rate: float) -> None:
    """Whatever the record is, there are finite coefficients and a finite band, or one sentence."""
    t = np.arange(3000.0)
    curves = {
        "alternating": (-1.0) ** t, "sine": np.sin(t / 7.0), "step": t > 1500, "impulse": t == 300, "ramp": 2.0 * t,
        "first": t == 0, "cosine": np.cos(math.pi * 5 * (t + 0.5) / t.size),
        "held": np.repeat(np.random.default_rng(1).standard_normal(30), 100),
        "cauchy": np.random.default_rng(2).standard_cauchy(t.size),
    }  # fmt: skip
    rate = np.asarray(curves[name], dtype=np.float64)
    try:
        found = identify(rate, sample_rate)
    except EstimateError:
        assert name not in {"step", "impulse", "cauchy"}
        return
    band = allan_curve(rate, sample_rate, found.noise)
    assert np.isfinite(band.low).all()
    assert np.isfinite(band.high).all()
    assert all(np.isfinite([each.value, each.sd or 0.0, each.upper_bound or 0.0]).all() for each in found.coefficients)


def test_a_million_samples_take_less_than_two_seconds() -> None:
    """Identification and Allan deviation of 10,000 s at 100 Hz."""
    rate = np.random.default_rng(2).standard_normal(1_000_000) * 1e-3
    began = time.process_time()
    allan_curve(rate, 100.0, identify(rate, 100.0).noise)
    assert time.process_time() - began < 2.0
