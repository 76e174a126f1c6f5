"""Levelling by accelerometers: the tilt found, its standard deviation, and what turning takes out of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from northfinder.errors import EstimateError
from northfinder.estimation import RateMeans
from northfinder.estimation.levelling import level
from northfinder.solution import levelling_to_json
from sim_device.plant.earth import Site, pedestal_attitude, project

Array = NDArray[np.float64]

GRAVITY = 9.81
MILLI_G = 9.80665e-3
LEVEL = ((0.0, 0.0),)
AROUND = ((0.0, 0.0), (90.0, 0.0), (180.0, 0.0), (270.0, 0.0))
SIX = (*AROUND, (0.0, 90.0), (0.0, -90.0))


def means_of(
    positions: tuple[tuple[float, float], ...],
    tilt: tuple[float, float],
    *,
    bias: ArrayLike = 0.0,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    n_each: int = 20,
) -> RateMeans:
    """Return means of a triad in `positions`, degrees, on a pedestal with `tilt`, rad, by the emulator's geometry."""
    site = Site(latitude=0.5, heading=1.0, tilt=tilt)
    up = [project(site, np.eye(3), *map(math.radians, angles)).up[0] for angles in positions]
    order = np.repeat(np.arange(len(positions)), n_each)
    force = GRAVITY * np.array(up)[order] + np.broadcast_to(bias, 3)
    if rng is not None:
        force = force + noise * rng.standard_normal(force.shape)
    azimuth, elevation = np.radians(np.array(positions)[order]).T
    return RateMeans(
        start=np.arange(order.size), duration=np.ones(order.size), rate=np.zeros((order.size, 3)), azimuth=azimuth,
        elevation=elevation, dwell=order, specific_force=force,
    )  # fmt: skip


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (1e-4, -3e-4), (0.1, 0.05), (-0.4, 0.3), (0.0, 0.9)])
@pytest.mark.parametrize("positions", [LEVEL, ((37.0, 12.0),), AROUND, SIX])
def test_the_tilt_of_the_pedestal_is_found(
    tilt: tuple[float, float], positions: tuple[tuple[float, float], ...]
) -> None:
    """Exactly, in any attitude of the stage, for small and large tilts."""
    found = level(means_of(positions, tilt), bias_sd=0.0)
    np.testing.assert_allclose(found.tilt, tilt, atol=1e-9)
    assert found.specific_force == pytest.approx(GRAVITY, abs=1e-8)


@pytest.mark.parametrize("tilt", [(0.02, 0.03), (-0.5, 0.2), (0.3, -0.6)])
def test_the_twist_is_where_stage_azimuth_zero_points_on_the_ground(tilt: tuple[float, float]) -> None:
    """The level projection of stage azimuth zero, as the emulator's matrices turn it."""
    x = pedestal_attitude(Site(latitude=0.0, heading=0.7, tilt=tilt))[:, 0]
    found = level(means_of(LEVEL, tilt))
    assert math.remainder(math.atan2(x[1], x[0]) - 0.7 - found.twist, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_turning_takes_the_biases_out() -> None:
    """5 mg of bias: whole in the tilt at one attitude, gone with four around the horizon, and told what they are."""
    bias = np.array([5.0, -3.0, 2.0]) * MILLI_G
    at_rest = level(means_of(LEVEL, (0.01, 0.02), bias=bias), bias_sd=5 * MILLI_G)
    assert at_rest.tilt[0] - 0.01 == pytest.approx(-5 * MILLI_G / GRAVITY, rel=0.05)
    assert at_rest.tilt_sd == pytest.approx(5 * MILLI_G / GRAVITY, rel=0.02)
    for bias_sd in (5 * MILLI_G, None):
        turned = level(means_of(AROUND, (0.01, 0.02), bias=bias), bias_sd=bias_sd)
        assert math.dist(turned.tilt, (0.01, 0.02)) == pytest.approx(
            math.hypot(0.01, 0.02) * 2 * MILLI_G / GRAVITY, rel=0.01
        )
        assert turned.tilt_sd < (2e-4 if bias_sd else 2e-3)
        np.testing.assert_allclose(turned.bias[:2], bias[:2], atol=1e-3)
    report = levelling_to_json(turned)["levelling"]
    assert report["accelerometer_bias_mg"][:2] == pytest.approx([5.0, -3.0], abs=0.1)
    assert report["tilt_y_deg"] == pytest.approx(math.degrees(0.02), abs=0.01)


N_RUNS = 400
#: rms of 2 N_RUNS normalised errors, 4 standard deviations: 1 +- 4 / sqrt(4 n).
BOUND = 4.0 / math.sqrt(4.0 * N_RUNS)


@pytest.mark.parametrize("positions", [LEVEL, AROUND, SIX])
def test_the_stated_sd_of_the_tilt_holds(positions: tuple[tuple[float, float], ...]) -> None:
    """Over 400 draws of biases and noise, where the biases rule and where the noise does."""
    rng = np.random.default_rng(len(positions))
    errors = []
    for _ in range(N_RUNS):
        bias = rng.normal(0.0, MILLI_G, 3)
        found = level(means_of(positions, (0.01, -0.02), bias=bias, noise=0.02, rng=rng), bias_sd=MILLI_G)
        errors += [(found.tilt[0] - 0.01) / found.tilt_sd, (found.tilt[1] + 0.02) / found.tilt_sd]
    rms = math.sqrt(np.mean(np.square(errors)))
    # The sd is the larger one of the two directions: with positions up and down they differ.
    assert (0.7 if positions == SIX else 1.0 - BOUND) < rms < 1.0 + BOUND


def test_what_is_not_gravity_or_lies_over_is_refused() -> None:
    """Accelerometers in another unit; a triad on its side, whose first axis points nowhere on the ground."""
    means = means_of(LEVEL, (0.0, 0.0))
    wrong = RateMeans(
        start=means.start, duration=means.duration, rate=means.rate, azimuth=means.azimuth, elevation=means.elevation,
        specific_force=means.specific_force / GRAVITY,
    )  # fmt: skip
    with pytest.raises(EstimateError, match="the accelerometers read 1 m/s"):
        level(wrong)
    with pytest.raises(EstimateError, match=r"third axis leans 86 deg .* mount the triad with its third axis down"):
        level(means_of(LEVEL, (1.5, 0.0)))


def test_without_a_tilt_nothing_is_twisted() -> None:
    """A level pedestal has no twist, and no division by its tilt."""
    assert replace(level(means_of(LEVEL, (0.0, 0.0))), tilt=(0.0, 0.0)).twist == 0.0
