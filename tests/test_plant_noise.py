"""The gyro's noise is what its coefficients say, and does not depend on how it is read."""

from __future__ import annotations

import math
import time
from itertools import pairwise

import allantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_device.plant.gyro import DPH, noise_coefficients, seed_of
from sim_device.plant.noise import (
    RATIO,
    SLOWEST_RATE,
    BufferedNoise,
    NoiseCoefficients,
    RateNoise,
    RecordedNoise,
)
from sim_device.plant.profile import load_profile

ALL_KINDS = NoiseCoefficients(
    angle_white_noise=1e-6, angle_random_walk=1e-7, bias_instability=1e-7, rate_random_walk=1e-8, rate_ramp=1e-10
)
TVG43 = noise_coefficients(load_profile("tvg43").gyro.noise)


def stream(coefficients: NoiseCoefficients, sample_rate: float, *seed: int) -> RateNoise:
    """Return a fresh stream."""
    return RateNoise(coefficients, sample_rate, seed_of(*seed))


def theory(coefficients: NoiseCoefficients, tau: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Allan deviation by the table of IEEE Std 952, flicker at its floor."""
    return np.sqrt(
        3 * (coefficients.angle_white_noise / tau) ** 2
        + coefficients.angle_random_walk**2 / tau
        + 2 * math.log(2) / math.pi * coefficients.bias_instability**2
        + coefficients.rate_random_walk**2 * tau / 3
        + (coefficients.rate_ramp * tau) ** 2 / 2
    )


def allan(rates: NDArray[np.float64], sample_rate: float, tau: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the overlapping Allan deviation at `tau`."""
    found, deviation, _, _ = allantools.oadev(rates, rate=sample_rate, data_type="freq", taus=tau)
    assert np.allclose(found, tau)
    return np.asarray(deviation)


KINDS = {
    "angle white noise": NoiseCoefficients(angle_white_noise=2e-6),
    "angle random walk": NoiseCoefficients(angle_random_walk=1e-7),
    "bias instability": NoiseCoefficients(bias_instability=3e-7),
    "rate random walk": NoiseCoefficients(rate_random_walk=1e-8),
    "rate ramp": NoiseCoefficients(rate_ramp=1e-10),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sample_rate", [1.0, 235.0])
def test_allan_deviation_of_each_kind(kind: str, sample_rate: float) -> None:
    """Each kind has its Allan deviation, with the scatter that the number of clusters allows."""
    n_runs, n = 8, 100_000
    tau = np.array([2.0, 8.0, 32.0]) if sample_rate > 1 else np.array([2.0, 8.0, 64.0, 512.0])
    variances = np.array(
        [allan(stream(KINDS[kind], sample_rate, 5, run).read(n), sample_rate, tau) ** 2 for run in range(n_runs)]
    )
    # at least (clusters - 1) degrees of freedom a run; the sd of a variance is sqrt(2 / degrees) of it
    degrees = n_runs * (n / sample_rate / tau - 1)
    error = variances.mean(axis=0) / theory(KINDS[kind], tau) ** 2 - 1
    assert np.all(np.abs(error) < 4 * np.sqrt(2 / degrees) + 0.02)  # 2 % for the approximation of 1/f


def test_allan_deviation_of_tvg43() -> None:
    """The profile tvg43 has the Allan deviation of its coefficients, from the wire's rate and from 1 s means."""
    tau = np.array([1.0, 4.0, 16.0, 64.0])
    n_runs, duration = 6, 2000
    variances = np.array(
        [allan(stream(TVG43, 235.0, 11, run).read(235 * duration), 235.0, tau) ** 2 for run in range(n_runs)]
    )
    error = variances.mean(axis=0) / theory(TVG43, tau) ** 2 - 1
    assert np.all(np.abs(error) < 4 * np.sqrt(2 / (n_runs * (duration / tau - 1))) + 0.02)
    tau = np.array([1.0, 8.0, 128.0, 2048.0])
    variances = np.array([allan(stream(TVG43, 1.0, 12, run).read(50_000), 1.0, tau) ** 2 for run in range(20)])
    error = variances.mean(axis=0) / theory(TVG43, tau) ** 2 - 1
    assert np.all(np.abs(error) < 4 * np.sqrt(2 / (20 * (50_000 / tau - 1))) + 0.02)


def test_sum_of_processes_is_flicker_within_one_percent() -> None:
    """The Allan deviation of the sum of Gauss-Markov processes, in closed form, is 0.664 B from 1/235 s to 1e5 s."""
    tau = np.geomspace(1 / 235, 1e5, 200)
    rates = SLOWEST_RATE * RATIO ** np.arange(60)
    step = np.multiply.outer(tau, rates)
    decay = -np.expm1(-step)
    small = step < 1e-4
    exact = 2 * (step - decay) / step**2 - (decay / step) ** 2  # variance of a mean, minus covariance of neighbours
    allan_variance = np.where(small, 2 * step / 3, exact).sum(axis=1) * math.log(RATIO) / math.pi
    assert np.abs(np.sqrt(allan_variance) / math.sqrt(2 * math.log(2) / math.pi) - 1).max() < 0.01


def test_means_at_one_second_are_the_same_physics() -> None:
    """1 s means of the stream at 50 samples/s scatter as the stream at 1 sample/s does, for every kind."""
    n = 20_000
    fine = stream(ALL_KINDS, 50.0, 3).read(50 * n).reshape(n, 50).mean(axis=1)
    coarse = stream(ALL_KINDS, 1.0, 4).read(n)
    assert np.std(np.diff(fine)) == pytest.approx(np.std(np.diff(coarse)), rel=5 * math.sqrt(2) / math.sqrt(n))


def test_rate_random_walk_grows_as_defined() -> None:
    """The variance of the bias grows by K^2 a second, mean over the interval included."""
    coefficients = NoiseCoefficients(rate_random_walk=1.0)
    last = np.array([stream(coefficients, 0.5, 8, run).read(50)[-1] for run in range(2000)])
    # mean over (98, 100) s of a Wiener process: 98 + 2/3; sd of a variance of 2000 draws: 3.2 %
    assert np.var(last) == pytest.approx(98 + 2 / 3, rel=0.13)


@settings(max_examples=40, deadline=None)
@given(sizes=st.lists(st.integers(0, 300), min_size=1, max_size=12), batch=st.sampled_from([1, 64, 1000]))
def test_chunking_changes_nothing(sizes: list[int], batch: int) -> None:
    """However the samples are fetched, they are the same to the last bit."""
    whole = stream(ALL_KINDS, 235.0, 1).read(sum(sizes))
    noise = BufferedNoise(stream(ALL_KINDS, 235.0, 1), batch)
    assert np.array_equal(np.concatenate([noise.read(n) for n in sizes]), whole)


def test_seeds() -> None:
    """The same seed gives the same noise, another seed or axis another, uncorrelated one."""
    first = stream(ALL_KINDS, 235.0, 1, 0).read(4000)
    assert np.array_equal(first, stream(ALL_KINDS, 235.0, 1, 0).read(4000))
    for other in (stream(ALL_KINDS, 235.0, 1, 1), stream(ALL_KINDS, 235.0, 2, 0)):
        assert abs(np.corrcoef(np.diff(first), np.diff(other.read(4000)))[0, 1]) < 5 / math.sqrt(4000)


def test_dwell_mean_of_tvg43_is_the_published_one() -> None:
    """Raw rate scatters by 253.8 deg/h, and its end points alone leave 0.018 deg/h in a minute's mean."""
    angle_white = NoiseCoefficients(angle_white_noise=TVG43.angle_white_noise)
    rates = stream(angle_white, 235.0, 9).read(235 * 60 * 400) / DPH
    assert rates.std() == pytest.approx(253.8, rel=0.005)
    minutes = rates.reshape(400, -1).mean(axis=1)
    assert minutes.std() == pytest.approx(0.018, rel=4 / math.sqrt(2 * 400))


def test_noise_is_fast() -> None:
    """A batch of tvg43's noise takes well under 2 us a sample, the best of several tries."""
    noise = stream(TVG43, 235.0, 1)

    def seconds() -> float:
        begin = time.perf_counter()
        noise.read(100_000)
        return time.perf_counter() - begin

    assert min(seconds() for _ in range(3)) < 0.2


def test_recording_plays_as_it_is() -> None:
    """At its own sample rate a recording comes out sample by sample, its mean taken off; twice slower, in means."""
    rates = np.random.default_rng(2).standard_normal(1000)
    centred = rates - rates.mean()
    noise = RecordedNoise(rates, 100.0, sample_rate=100.0)
    assert np.concatenate([noise.read(300), noise.read(700)]) == pytest.approx(centred, abs=1e-9)
    halved = RecordedNoise(rates, 100.0, sample_rate=50.0).read(500)
    assert halved == pytest.approx(centred.reshape(-1, 2).mean(axis=1), abs=1e-9)


def test_recording_too_short() -> None:
    """A recording that ends is refused with its length, or begins again if that is allowed."""
    rates = np.arange(10.0)
    with pytest.raises(ValueError, match=r"lasts 0.1 s .* but 0.11 s were asked for"):
        RecordedNoise(rates, 100.0, sample_rate=100.0).read(11)
    with pytest.raises(ValueError, match=r"lasts 0.05 s from its start index 5"):
        RecordedNoise(rates, 100.0, sample_rate=100.0, start=5).read(6)
    repeated = RecordedNoise(rates, 100.0, sample_rate=100.0, start=5, repeat=True).read(25)
    assert repeated == pytest.approx(np.roll(np.tile(rates - 4.5, 3), -5)[:25])
    with pytest.raises(ValueError, match="finite"):
        RecordedNoise(np.array([1.0, np.nan]), 100.0, sample_rate=100.0)


def test_flicker_processes_do_not_step_between_reads() -> None:
    """The slow part of the noise goes on over the reads: no pair of neighbours differs more than the others."""
    noise = stream(NoiseCoefficients(rate_random_walk=1.0), 1.0, 1)
    chunks = [noise.read(100) for _ in range(200)]
    joints = np.array([after[0] - before[-1] for before, after in pairwise(chunks)])
    assert np.std(joints) == pytest.approx(np.std(np.diff(np.concatenate(chunks))), rel=4 / math.sqrt(2 * 199))
