"""Biases known beforehand in the linear model: a triad at rest and one turned by half a turn, and their budgets."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated_means import DPH, OMEGA_DPH, draw_noise

from northfinder.errors import EstimateError
from northfinder.estimation import Known, NoiseModel, RateMeans, estimate
from northfinder.estimation.budget import Declared, declared_variance, error_budget
from northfinder.estimation.geometry import rates, sensitivity
from northfinder.estimation.triad import gyrocompass, static_mean

Array = NDArray[np.float64]

NOISE_OF = {"angle_random_walk_deg_per_sqrt_h": 0.003, "bias_instability_dph": 0.02}
NOISE = NoiseModel.from_field_units(**NOISE_OF)
BIAS_SD = 0.3 * DPH
LATITUDE = math.radians(50.0)
STATIC, HALF_TURN = (0.0,), (0.0, 180.0)


def means_at(
    azimuths_deg: tuple[float, ...],
    *,
    heading: float,
    latitude: float = LATITUDE,
    tilt: tuple[float, float] = (0.0, 0.0),
    n: int = 30,
) -> RateMeans:
    """Return noise-free means of 5 s of a triad, `n` in each position, with 20 s for a turn."""
    order = np.repeat(np.arange(len(azimuths_deg)), n)
    azimuth = np.radians(np.array(azimuths_deg))[order]
    start = np.arange(order.size) * 5.0 + order * 20.0
    tilts = np.tile(tilt, (order.size, 1))
    rate = sensitivity(azimuth, np.zeros(order.size), tilts, n_axes=3) @ rates(heading, latitude)
    return RateMeans(
        start=start, duration=np.full(order.size, 5.0), rate=rate, azimuth=azimuth, elevation=np.zeros(order.size),
        tilt=tilts, dwell=order, n_samples=np.full(order.size, 50),
    )  # fmt: skip


def test_one_position_is_the_analytic_gyrocompass() -> None:
    """With known biases the linear model at one attitude is [S1] (4), to the last digit, with the same sd."""
    rng = np.random.default_rng(3)
    clean = means_at(STATIC, heading=4.0, tilt=(0.0, 0.0))
    means = clean.with_rate(clean.rate + BIAS_SD * rng.standard_normal(3))
    fix = estimate(means, noise=NOISE, known=Known(bias_sd=BIAS_SD), weights="generalised")
    force = np.tile([0.0, 0.0, -9.81], (means.n, 1))
    triad = gyrocompass(static_mean("p", means.rate, force), gyro_bias_sd=BIAS_SD)
    assert fix.azimuth == pytest.approx(triad.axes[0][0].azimuth, abs=1e-9)
    assert fix.latitude == pytest.approx(triad.latitude, abs=1e-9)
    assert triad.axes[0][0].azimuth_sd is not None
    assert fix.azimuth_sd == pytest.approx(math.hypot(BIAS_SD, 0.02 * DPH) / math.hypot(*fix.rates[:2]), rel=0.01)
    np.testing.assert_allclose(fix.bias, 0.0, atol=1e-6 * DPH)


def test_unknown_biases_leave_one_position_open() -> None:
    """Refused by name, for one gyro at rest as for three; and known ones need a noise to be weighed against."""
    means = means_at(STATIC, heading=1.0)
    with pytest.raises(EstimateError, match="these positions do not determine"):
        estimate(means, noise=NOISE, weights="generalised")
    alone = RateMeans(
        start=means.start, duration=means.duration, rate=means.rate[:, 0], azimuth=means.azimuth,
        elevation=means.elevation,
    )  # fmt: skip
    with pytest.raises(EstimateError, match="these positions do not determine"):
        estimate(alone, noise=NOISE, known=Known(bias_sd=BIAS_SD), weights="generalised")
    with pytest.raises(ValueError, match="known biases need a noise model"):
        estimate(means, known=Known(bias_sd=BIAS_SD))


N_RUNS = 200
BOUND = 4.0 / math.sqrt(2.0 * N_RUNS)


@pytest.mark.parametrize("azimuths", [STATIC, HALF_TURN])
@pytest.mark.parametrize("weights", ["generalised", "ordinary"])
def test_the_stated_sd_holds_when_biases_are_unknown(azimuths: tuple[float, ...], weights: str) -> None:
    """Azimuth and latitude over 200 draws of biases, noise and heading: as they say, neither more nor less."""
    rng = np.random.default_rng(len(azimuths))
    template = means_at(azimuths, heading=0.0)
    noise = draw_noise(rng, template, 3 * N_RUNS, **NOISE_OF).reshape(N_RUNS, 3, -1).swapaxes(1, 2)
    errors = []
    for run in range(N_RUNS):
        heading = rng.uniform(0.0, 2.0 * math.pi)
        clean = means_at(azimuths, heading=heading)
        means = clean.with_rate(clean.rate + noise[run] + BIAS_SD * rng.standard_normal(3))
        fix = estimate(means, noise=NOISE, known=Known(bias_sd=BIAS_SD), weights=weights)  # type: ignore[arg-type]
        assert fix.latitude is not None
        assert fix.latitude_sd is not None
        errors.append(
            [
                math.remainder(fix.azimuth - heading, 2.0 * math.pi) / fix.azimuth_sd,
                (fix.latitude - LATITUDE) / fix.latitude_sd,
            ]
        )
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all(np.abs(rms - 1.0) < BOUND), rms


def test_half_a_turn_takes_the_level_biases_out() -> None:
    """The azimuth gets as sure as the noise allows; the latitude still rests on the vertical gyro's bias."""
    known = Known(bias_sd=BIAS_SD)
    at_rest, turned = (
        estimate(means_at(azimuths, heading=2.0), noise=NOISE, known=known, weights="generalised")
        for azimuths in (STATIC, HALF_TURN)
    )
    assert turned.azimuth_sd < at_rest.azimuth_sd / 10.0
    assert turned.latitude_sd == pytest.approx(BIAS_SD * math.cos(LATITUDE) / (OMEGA_DPH * DPH), rel=0.05)


@pytest.mark.parametrize("azimuths", [STATIC, HALF_TURN])
@pytest.mark.parametrize("weights", ["generalised", "ordinary"])
def test_the_budget_adds_up_to_what_is_stated(azimuths: tuple[float, ...], weights: str) -> None:
    """With biases, tilt and a turn by hand in it; at rest the bias leads it, by the east gyro's share."""
    means = means_at(azimuths, heading=2.0, tilt=(0.01, -0.02))
    known = Known(bias_sd=BIAS_SD, tilt_sd=1e-4)
    declared = Declared(turn_sd=math.radians(0.5) if len(azimuths) > 1 else 0.0)
    given = {"noise": NOISE, "known": known, "weights": weights}
    fix = estimate(means, **given)  # type: ignore[arg-type]
    added = declared_variance(means, fix, drift="constant", declared=declared, **given)  # type: ignore[arg-type]
    fix = replace(fix, azimuth_sd=math.sqrt(fix.azimuth_sd**2 + added[0]))
    budget = error_budget(means, fix, declared=declared, **given)  # type: ignore[arg-type]
    assert budget.azimuth_sd == pytest.approx(fix.azimuth_sd, rel=0.01)
    line = {each.quantity: each.azimuth for each in budget.contributions}
    if len(azimuths) == 1:
        assert budget.contributions[0].quantity == "bias"
        assert line["bias"] == pytest.approx(BIAS_SD / (OMEGA_DPH * DPH * math.cos(LATITUDE)), rel=0.05)
        assert "turn by hand" not in line
    else:
        assert line["turn by hand"] == pytest.approx(math.radians(0.25), rel=0.05)
