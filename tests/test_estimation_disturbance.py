"""Knocks are found and left out, and cost next to nothing; quiet data are left alone."""

from __future__ import annotations

import math

import numpy as np
from simulated_means import DPH, TVG43, draw_noise, make_means

from northfinder.estimation import NoiseModel, RateMeans, estimate
from northfinder.estimation.disturbance import undisturbed

NOISE = NoiseModel.from_field_units(**TVG43)
CLEAN = make_means(45.0, 50.0, mean=2.0)


def noisy_cycles(n: int) -> list[RateMeans]:
    """Seeded cycles of the published cyclogram with the gyro's noise."""
    drawn = draw_noise(np.random.default_rng(21), CLEAN, n, sample_rate=2.0, **TVG43)
    return [CLEAN.with_rate(CLEAN.rate[:, 0] + noise) for noise in drawn]


def knocked(means: RateMeans, rng: np.random.Generator) -> tuple[RateMeans, np.ndarray]:
    """Two in a hundred means displaced by 100 sd of a mean, either way."""
    hit = rng.random(means.n) < 0.02
    size = 100.0 * math.sqrt(2.0) * TVG43["angle_white_noise_dph_s"] / 2.0 * DPH
    return means.with_rate(means.rate[:, 0] + hit * size * rng.choice([-1.0, 1.0], means.n)), hit


def test_every_knock_is_found_and_hardly_a_good_mean_is_lost() -> None:
    """All knocks of 100 sd are out; of the good means less than one in a thousand."""
    rng = np.random.default_rng(22)
    lost = total = 0
    for cycle in noisy_cycles(20):
        means, hit = knocked(cycle, rng)
        keep = undisturbed(means)
        assert not np.any(keep & hit)
        lost += int(np.sum(~keep & ~hit))
        total += int(np.sum(~hit))
    assert lost < 1e-3 * total


def test_knocks_cost_less_than_a_tenth() -> None:
    """With the knocks left out azimuths scatter like those without knocks; left in, they are useless."""
    rng = np.random.default_rng(23)
    errors: dict[str, list[float]] = {"quiet": [], "left out": [], "left in": []}
    for cycle in noisy_cycles(100):
        means, _ = knocked(cycle, rng)
        versions = {"quiet": cycle, "left out": means.select(undisturbed(means)), "left in": means}
        for name, version in versions.items():
            fix = estimate(version, noise=NOISE, weights="generalised")
            errors[name].append(fix.azimuth - math.radians(45.0))
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in errors.items()}
    assert rms["left out"] < 1.1 * rms["quiet"]
    assert rms["left in"] > 2.0 * rms["quiet"]


def test_one_disturbed_axis_of_three_takes_the_mean_out() -> None:
    """A knock seen by one axis only disturbs the whole mean."""
    rng = np.random.default_rng(24)
    rate = 0.1 * DPH * rng.standard_normal((CLEAN.n, 3)) + CLEAN.rate
    rate[17, 2] += 10.0 * DPH
    assert np.flatnonzero(~undisturbed(CLEAN.with_rate(rate))).tolist() == [17]


def test_too_few_means_to_judge_are_all_kept() -> None:
    """One mean a dwell has no neighbours to differ from, and data without noise have no outliers."""
    assert undisturbed(CLEAN.per_dwell()).all()
    assert undisturbed(CLEAN).all()


def test_the_odd_short_mean_of_angle_white_noise_is_kept() -> None:
    """A mean over a tenth of a second scatters ten times more than one over a second, and is no knock for that."""
    rng = np.random.default_rng(25)
    duration = np.tile([1.0, 1.0, 1.0, 1.0, 0.1], 40)
    noise = rng.standard_normal(duration.size) / duration
    means = RateMeans(
        start=np.cumsum(duration) - duration, duration=duration, rate=noise * DPH,
        azimuth=np.zeros(duration.size), elevation=np.zeros(duration.size), dwell=np.zeros(duration.size),
    )  # fmt: skip
    assert undisturbed(means).all()
