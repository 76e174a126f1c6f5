"""Gyro noise as a stream of rate samples, each the exact mean of a continuous process over its sample interval.

Kinds and coefficients are those of IEEE Std 952, annex on the Allan variance; docs/method.md section 2 has the figures.

====================  =======================================================  ===================
kind                  two-sided rate PSD                                       Allan deviation
====================  =======================================================  ===================
angle white noise     difference of white angle, sd ``q``                      ``sqrt(3) q / tau``
angle random walk     ``N^2``                                                  ``N / sqrt(tau)``
bias instability      ``B^2 / (2 pi f)``                                       ``0.664 B``
rate random walk      ``K^2 / (2 pi f)^2``                                     ``K sqrt(tau / 3)``
rate ramp             ``R t``                                                  ``R tau / sqrt(2)``
====================  =======================================================  ===================

The 1/f process is a sum of first-order Gauss-Markov processes of equal variance whose rates go up by a factor of 4.
Its PSD ripples by 0.3 %; its Allan deviation is within 1 % of ``0.664 B`` from one sample interval to 1e5 s (the test
calculates it). All processes are stationary from the first sample, as of a gyro that has been on for long; the rate
random walk and the ramp start at zero.

Each stream continues over calls and does not depend, to the last bit, on how many samples a call takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtbsv  # the whole of scipy.signal takes a second to import

Rates = NDArray[np.float64]  #: rad/s, shape (n,)

RATIO = 4.0  #: between the rates of neighbouring Gauss-Markov processes
SLOWEST_RATE = 2.0 * math.pi / (100 * 86_400.0)  #: rad/s: 1/f down to a period of 100 days
FASTEST_STEP = 1e4  #: rate x sample interval up to which processes count; the missing share is 6e-5 of a white noise
PIECE = 8192  #: samples made at a time: what stays in the cache
WHITE_STEP = 50.0  #: above this rate x sample interval the interval means of a process are white within 1 %


class NoiseSource(Protocol):
    """A stream of rate noise of one input axis."""

    def read(self, n: int) -> Rates:
        """Return the next `n` samples in rad/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseCoefficients:
    """Coefficients in SI units; zero leaves a kind out."""

    angle_white_noise: float = 0.0  #: rad, sd of the white angle ``q``
    angle_random_walk: float = 0.0  #: rad/sqrt(s), ``N``
    bias_instability: float = 0.0  #: rad/s, ``B``
    rate_random_walk: float = 0.0  #: rad/s/sqrt(s), ``K``
    rate_ramp: float = 0.0  #: rad/s^2, ``R``


@dataclass(frozen=True, slots=True)
class GaussMarkovMean:
    """How interval means of a Gauss-Markov process of unit variance follow from its state.

    With ``x`` the state at the start of an interval: ``x' = pole x + w`` and ``mean = start x + gain w + r``, where
    ``w`` and ``r`` are independent and white with the standard deviations `drive_sd` and `rest_sd`.
    """

    pole: float
    start: float
    gain: float
    drive_sd: float
    rest_sd: float


def gauss_markov_mean(step: float) -> GaussMarkovMean:
    """Return the exact discrete form for `step`, which is rate times sample interval.

    The process ``dx = -rate x dt + dW`` is integrated over the interval; ``w`` and the mean are jointly Gaussian.
    """
    decay = -math.expm1(-step)  # 1 - pole
    start = decay / step
    drive = -math.expm1(-2 * step)
    covariance = decay**2 / step  # of w and of the mean, given x
    variance = 2 * (step - decay) / step**2 - start**2  # of the mean, given x
    rest = variance - covariance**2 / drive
    if step < 1e-3:  # where the difference loses its digits, the leading term of its series
        rest = step / 6
    return GaussMarkovMean(1 - decay, start, covariance / drive, math.sqrt(drive), math.sqrt(max(rest, 0.0)))


class GaussMarkovStream:
    """Interval means of one Gauss-Markov process, without their white rest."""

    def __init__(self, form: GaussMarkovMean, sd: float, rng: np.random.Generator) -> None:
        self._rng = rng
        self._form = form
        self._drive_sd = sd * form.drive_sd
        self._state = sd * rng.standard_normal()

    def read(self, n: int) -> Rates:
        """Return the next `n` interval means."""
        drive = np.empty(n + 1)
        drive[0] = self._state
        drive[1:] = self._rng.standard_normal(n)
        drive[1:] *= self._drive_sd
        # the recursion x[i+1] - pole x[i] = w[i] as a triangular band of ones and -pole, solved from the top
        band = np.empty((2, n + 1), order="F")
        band[1] = -self._form.pole
        state = dtbsv(1, band, drive, lower=1, diag=1)
        self._state = state[n]
        means: Rates = self._form.start * state[:n]
        means += self._form.gain * drive[1:]
        return means


class RateNoise:
    """Noise of one input axis by its coefficients."""

    def __init__(self, coefficients: NoiseCoefficients, sample_rate: float, seed: np.random.SeedSequence) -> None:
        self._dt = 1.0 / sample_rate
        self._index = 0
        self._coefficients = coefficients
        seeds = iter(np.random.default_rng(child) for child in seed.spawn(64))
        self._angle_rng, self._white_rng, self._walk_rng = next(seeds), next(seeds), next(seeds)
        self._angle = coefficients.angle_white_noise * self._angle_rng.standard_normal()
        self._walk = 0.0
        white_variance = coefficients.angle_random_walk**2 / self._dt + coefficients.rate_random_walk**2 * self._dt / 12
        self._flicker: list[GaussMarkovStream] = []
        if coefficients.bias_instability:
            sd = coefficients.bias_instability * math.sqrt(math.log(RATIO) / math.pi)
            step = SLOWEST_RATE * self._dt
            while step < FASTEST_STEP:
                form = gauss_markov_mean(step)
                if step < WHITE_STEP:
                    white_variance += (sd * form.rest_sd) ** 2
                    self._flicker.append(GaussMarkovStream(form, sd, next(seeds)))
                else:
                    white_variance += sd**2 * (form.rest_sd**2 + (form.gain * form.drive_sd) ** 2 + form.start**2)
                step *= RATIO
        self._white_sd = math.sqrt(white_variance)

    def read(self, n: int) -> Rates:
        """Return the next `n` samples in rad/s."""
        out = np.zeros(n)
        for begin in range(0, n, PIECE):
            self._add(out[begin : begin + PIECE])
        return out

    def _add(self, out: Rates) -> None:
        """Add the next samples to `out`, in place."""
        n = out.size
        if self._white_sd:
            out += self._white_sd * self._white_rng.standard_normal(n)
        for stream in self._flicker:
            out += stream.read(n)
        if self._coefficients.angle_white_noise:
            out += self._angle_white_noise(n)
        if self._coefficients.rate_random_walk:
            out += self._rate_random_walk(n)
        if self._coefficients.rate_ramp:
            middle = (np.arange(self._index, self._index + n) + 0.5) * self._dt
            out += self._coefficients.rate_ramp * middle
        self._index += n

    def _angle_white_noise(self, n: int) -> Rates:
        angle = np.empty(n + 1)
        angle[0] = self._angle
        angle[1:] = self._coefficients.angle_white_noise * self._angle_rng.standard_normal(n)
        self._angle = angle[-1]
        return np.diff(angle) / self._dt

    def _rate_random_walk(self, n: int) -> Rates:
        """Return interval means of a Wiener process, but for their white rest of variance ``K^2 dt / 12``."""
        walk = np.empty(n + 1)
        walk[0] = self._walk
        walk[1:] = self._coefficients.rate_random_walk * math.sqrt(self._dt) * self._walk_rng.standard_normal(n)
        np.cumsum(walk, out=walk)
        self._walk = walk[-1]
        return 0.5 * (walk[:-1] + walk[1:])


class RecordedNoise:
    """A real recording as the noise: its angle is interpolated, so that any sample rate sees the right means.

    Parameters
    ----------
    rates
        Recording, rad/s, shape (n,); its mean is taken off, for the profile has its own bias.
    recorded_rate
        Samples a second of the recording.
    sample_rate
        Samples a second wanted.
    repeat
        Start again at its end instead of raising ValueError.

    """

    def __init__(
        self, rates: Rates, recorded_rate: float, *, sample_rate: float, start: int = 0, repeat: bool = False
    ) -> None:
        rates = np.asarray(rates, dtype=np.float64)
        if rates.ndim != 1 or rates.size == 0 or not np.isfinite(rates).all():
            raise ValueError(f"a noise recording must be one row of finite rates, got shape {rates.shape}")
        self._angle = np.concatenate([[0.0], np.cumsum(rates - rates.mean())]) / recorded_rate
        self._length = rates.size
        self._recorded_rate = recorded_rate
        self._sample_rate = sample_rate
        self._start = start
        self._repeat = repeat
        self._index = 0

    def read(self, n: int) -> Rates:
        """Return the next `n` samples in rad/s.

        Raises
        ------
        ValueError
            If the recording is too short and may not be repeated.

        """
        step = self._recorded_rate / self._sample_rate
        edges = self._start + np.arange(self._index, self._index + n + 1) * step
        if not self._repeat and edges[-1] > self._length + 1e-6:
            raise ValueError(
                f"the noise recording lasts {(self._length - self._start) / self._recorded_rate:g} s from its start "
                f"index {self._start}, but {(self._index + n) / self._sample_rate:g} s were asked for"
            )
        self._index += n
        # with its mean off the recording's angle ends where it began, so that it repeats without a step
        whole = np.floor(edges)
        before = whole.astype(np.int64) % self._length
        angle = self._angle[before] + (edges - whole) * (self._angle[before + 1] - self._angle[before])
        return np.diff(angle) * self._sample_rate  # type: ignore[no-any-return]  # NumPy forgets the type here


class BufferedNoise:
    """Any noise source read ahead in large batches, for a reader that takes a few samples a call."""

    def __init__(self, source: NoiseSource, batch: int) -> None:
        self._source = source
        self._batch = batch
        self._buffer: Rates = np.empty(0)
        self._next = 0

    def read(self, n: int) -> Rates:
        """Return the next `n` samples in rad/s."""
        left = self._buffer.size - self._next
        if n > left:
            fresh = self._source.read(max(self._batch, n - left))
            self._buffer = np.concatenate([self._buffer[self._next :], fresh])
            self._next = 0
        self._next += n
        return self._buffer[self._next - n : self._next]
