"""Interval means of a gyro simulated sample by sample, written apart from the estimators that are tested with them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from northfinder.estimation import RateMeans

Array = NDArray[np.float64]

OMEGA_DPH = 15.041067
DPH = math.radians(1.0) / 3600.0  # rad/s

U1, U2, U3, U4, U5, U6 = (0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90)
SIX = (U1, U2, U3, U4, U1, U5, U6, U1)  # the published cyclogram
TVG43 = {
    "angle_white_noise_dph_s": 0.764,
    "angle_random_walk_deg_per_sqrt_h": 0.003,
    "bias_instability_dph": 0.06,
    "rate_random_walk_dph_per_sqrt_h": 0.2,
}


def true_rate_dph(
    position_deg: tuple[float, float],
    azimuth_deg: float,
    latitude_deg: float,
    tilt: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Return the earth rate about the input axis by plain vectors; `azimuth_deg` is that of stage azimuth zero."""
    a, e = (math.radians(x) for x in position_deg)
    axis = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), -math.sin(e)])
    turn = np.array([tilt[1], -tilt[0], 0.0])
    angle = float(np.linalg.norm(turn))
    if angle > 0.0:
        k = turn / angle
        axis = axis * math.cos(angle) + np.cross(k, axis) * math.sin(angle) + k * (k @ axis) * (1.0 - math.cos(angle))
    c, s = math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))
    north, down = c * axis[0] - s * axis[1], axis[2]
    latitude = math.radians(latitude_deg)
    return float(OMEGA_DPH * (math.cos(latitude) * north - math.sin(latitude) * down))


def make_means(
    azimuth_deg: float,
    latitude_deg: float,
    *,
    positions: Sequence[tuple[float, float]] = SIX,
    dwell: float = 120.0,
    turn: float = 10.0,
    mean: float | None = None,
    tilt: tuple[float, float] = (0.0, 0.0),
    bias_dph: float = 38.0,
    drift_dph_per_h: float = 0.0,
    scale_factor: float = 1.0,
    d_g_dph: float = 0.0,
    sample_rate: float = 10.0,
) -> RateMeans:
    """Return noise-free means of `mean` seconds (of the whole dwell if None) over `positions`, degrees."""
    mean = dwell if mean is None else mean
    per_dwell = round(dwell / mean)
    order = np.repeat(np.arange(len(positions)), per_dwell)
    start = order * (dwell + turn) + np.tile(np.arange(per_dwell) * mean, len(positions))
    level = [scale_factor * true_rate_dph(p, azimuth_deg, latitude_deg, tilt) for p in positions]
    up = [true_rate_dph(p, 0.0, 90.0, tilt) / OMEGA_DPH for p in positions]
    rate = np.array(level)[order] + d_g_dph * np.array(up)[order] + bias_dph
    rate += drift_dph_per_h * (start + mean / 2.0 - np.mean(start + mean / 2.0)) / 3600.0
    angles = np.radians(np.array(positions, dtype=np.float64)[order])
    return RateMeans(
        start=start,
        duration=np.full(order.size, mean),
        rate=rate * DPH,
        azimuth=angles[:, 0],
        elevation=angles[:, 1],
        tilt=np.tile(tilt, (order.size, 1)),
        dwell=order,
        n_samples=np.full(order.size, round(mean * sample_rate)),
    )


def draw_noise(
    rng: np.random.Generator,
    means: RateMeans,
    n_runs: int,
    *,
    sample_rate: float = 10.0,
    angle_white_noise_dph_s: float = 0.0,
    angle_random_walk_deg_per_sqrt_h: float = 0.0,
    bias_instability_dph: float = 0.0,
    rate_random_walk_dph_per_sqrt_h: float = 0.0,
) -> Array:
    """Return noise of the means, rad/s, shape (n_runs, n): every sample drawn, then averaged over the intervals."""
    first = np.round((means.start - means.start[0]) * sample_rate).astype(int)
    last = first + np.round(means.duration * sample_rate).astype(int)
    n, dt = int(last[-1]), 1.0 / sample_rate
    runs = np.empty((n_runs, means.n))
    for run in range(n_runs):
        angle = angle_random_walk_deg_per_sqrt_h * 60.0 * np.sqrt(dt) * rng.standard_normal(n)  # deg/h*s a sample
        walk = np.cumsum(rate_random_walk_dph_per_sqrt_h * np.sqrt(dt / 3600.0) * rng.standard_normal(n))
        flicker = bias_instability_dph * _unit_flicker(rng, n, dt)
        total = np.concatenate([[0.0], np.cumsum(angle + (walk + flicker) * dt)])
        total += angle_white_noise_dph_s * rng.standard_normal(n + 1)
        runs[run] = (total[last] - total[first]) / means.duration
    return runs * DPH


def _unit_flicker(rng: np.random.Generator, n: int, dt: float) -> Array:
    """Return noise of two-sided spectral density 1/(2 pi f), from its Fourier series over four times the span."""
    size = 4 * n
    frequency = np.fft.rfftfreq(size, dt)[1:]
    sd = np.sqrt(2.0 / (2.0 * np.pi * frequency) / (size * dt))
    spectrum = np.concatenate([[0.0], sd * (rng.standard_normal(sd.size) + 1j * rng.standard_normal(sd.size))])
    return np.asarray(np.fft.irfft(spectrum, size)[:n] * size / 2.0)
