"""A vibratory gyro as physics: from attitude to rate, with its errors. Needs no firmware and no wire.

``U = (1 + dk) h.omega + bias(t) + d_g (h.up) + noise`` (docs/method.md section 1), then the range and the resolution.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_device.plant.earth import Projection, Site, input_axes, project
from sim_device.plant.noise import BufferedNoise, NoiseCoefficients, NoiseSource, RateNoise, RecordedNoise
from sim_device.plant.profile import GyroProfile, NoiseProfile, RecordingProfile

DPH = math.radians(1.0) / 3600.0  #: rad/s in one deg/h
ARCSEC = math.radians(1.0) / 3600.0  #: rad in one arc second

#: First number of the spawn key of each random stream: the seed of a bench makes all of them, none depends on another.
STREAM_TURN_ON, STREAM_NOISE, STREAM_STAGE, STREAM_TILT, STREAM_FAULTS, STREAM_ACCELEROMETERS = range(6)


def seed_of(seed: int, *stream: int) -> np.random.SeedSequence:
    """Return the seed of one random stream of a bench."""
    return np.random.SeedSequence(seed, spawn_key=stream)


def noise_coefficients(profile: NoiseProfile) -> NoiseCoefficients:
    """Return the coefficients of a profile in SI units."""
    return NoiseCoefficients(
        angle_white_noise=profile.angle_white_noise_dph_s * DPH,
        angle_random_walk=math.radians(profile.angle_random_walk_deg_per_sqrt_h) / 60.0,
        bias_instability=profile.bias_instability_dph * DPH,
        rate_random_walk=profile.rate_random_walk_dph_per_sqrt_h * DPH / 60.0,
        rate_ramp=profile.rate_ramp_dph_per_h * DPH / 3600.0,
    )


def load_recording(profile: RecordingProfile) -> NDArray[np.float64]:
    """Return the rates of a recording in rad/s, shape (n,).

    Raises
    ------
    ValueError
        If the file cannot be read or does not hold the array.

    """
    try:
        loaded = np.load(profile.file, allow_pickle=False)
        counts = loaded if isinstance(loaded, np.ndarray) else loaded[profile.key]
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"noise recording {profile.file}: cannot read array {profile.key!r} ({error})") from error
    return np.asarray(counts, dtype=np.float64) * (profile.dph_per_count * DPH)


class Gyro:
    """The gyro of a profile at a site; each call of `measure` continues the stream of samples.

    Parameters
    ----------
    profile
        What gyro it is.
    site
        Where its pedestal stands.
    seed
        Of all that is random here.
    start
        Which start of the gyro this is: another one draws another turn-on bias and other noise.
    sample_rate
        Samples a second, that of the profile if None. At 1.0 the samples are 1 s means of the same physics.
    noise
        Noise of each axis instead of the profile's.
    batch
        Samples of noise made at a time; the noise itself does not depend on it.

    """

    def __init__(
        self,
        profile: GyroProfile,
        site: Site,
        *,
        seed: int,
        start: int = 0,
        sample_rate: float | None = None,
        noise: list[NoiseSource] | None = None,
        batch: int = 1,
    ) -> None:
        self.profile = profile
        self.site = site
        self.sample_rate = sample_rate or profile.sample_rate_hz
        self.saturated = False  #: whether the last `measure` left the range
        self.temperature = profile.temperature.ambient_c  #: degrees Celsius, at the end of the last `measure`
        misalignment = np.array(profile.input_axis_misalignment_arcsec or np.zeros((profile.n_axes, 3))) * ARCSEC
        self._axes = input_axes(profile.n_axes, misalignment)
        turn_on = np.random.default_rng(seed_of(seed, STREAM_TURN_ON, start)).standard_normal(profile.n_axes)
        #: rad/s, shape (n_axes,), constant until the gyro is switched off
        self.bias = (profile.bias_dph + profile.turn_on_bias_sd_dph * turn_on) * DPH
        self._index = 0
        self._at_rest: tuple[tuple[float, float], NDArray[np.float64]] | None = None
        self._noise = noise if noise is not None else self._make_noise(seed, start, batch)
        if len(self._noise) != profile.n_axes:
            raise ValueError(f"the gyro has {profile.n_axes} axes, but noise was given for {len(self._noise)}")

    def _make_noise(self, seed: int, start: int, batch: int) -> list[NoiseSource]:
        recording = self.profile.recording
        if recording is not None:
            rates = load_recording(recording)
            length = len(rates) // self.profile.n_axes  # each axis starts elsewhere in it
            return [
                RecordedNoise(
                    rates,
                    recording.sample_rate_hz,
                    sample_rate=self.sample_rate,
                    start=recording.start + axis * length,
                    repeat=recording.repeat,
                )
                for axis in range(self.profile.n_axes)
            ]
        coefficients = noise_coefficients(self.profile.noise)
        sources = [
            RateNoise(coefficients, self.sample_rate, seed_of(seed, STREAM_NOISE, start, axis))
            for axis in range(self.profile.n_axes)
        ]
        return [BufferedNoise(source, batch) if batch > 1 else source for source in sources]

    def measure(
        self,
        azimuth: ArrayLike,
        elevation: ArrayLike,
        *,
        azimuth_rate: ArrayLike = 0.0,
        elevation_rate: ArrayLike = 0.0,
    ) -> NDArray[np.float64]:
        """Return the next samples at these true stage angles.

        Parameters
        ----------
        azimuth, elevation
            Rad, shape (n,), one for each sample.
        azimuth_rate, elevation_rate
            Rotation of the stage, rad/s, shape (n,) or a scalar.

        Returns
        -------
        ndarray
            Rad/s, shape (n, n_axes).

        """
        seen = project(
            self.site, self._axes, azimuth, elevation, azimuth_rate=azimuth_rate, elevation_rate=elevation_rate
        )
        return self._finish(self._ideal(seen))

    def measure_at_rest(self, azimuth: float, elevation: float, n: int) -> NDArray[np.float64]:
        """Return the next `n` samples with the stage at rest: as `measure`, faster."""
        if self._at_rest is None or self._at_rest[0] != (azimuth, elevation):
            seen = project(self.site, self._axes, azimuth, elevation)
            self._at_rest = (azimuth, elevation), self._ideal(seen)
        return self._finish(np.repeat(self._at_rest[1], n, axis=0))

    def skip(self, n: int) -> None:
        """Let `n` samples pass unread."""
        for source in self._noise:
            for begin in range(0, n, 65_536):
                source.read(min(65_536, n - begin))
        self._index += n

    def _ideal(self, seen: Projection) -> NDArray[np.float64]:
        drift = self.profile.acceleration_sensitive_drift_rate_dph_per_g * DPH
        return (1.0 + self.profile.scale_factor_error) * seen.rate + self.bias + drift * seen.up

    def _finish(self, rate: NDArray[np.float64]) -> NDArray[np.float64]:
        """Add to `rate`, in place, what depends on time, then apply range and resolution."""
        n = rate.shape[0]
        for axis, source in enumerate(self._noise):
            rate[:, axis] += source.read(n)
        rate += self._temperature_bias(n)
        limit = self.profile.range_dph * DPH
        self.saturated = bool(n and max(rate.max(), -rate.min()) > limit)
        if self.saturated:
            np.clip(rate, -limit, limit, out=rate)
        if self.profile.resolution_dph:
            lsb = self.profile.resolution_dph * DPH
            rate = np.rint(rate / lsb) * lsb
        return rate

    def _temperature_bias(self, n: int) -> NDArray[np.float64] | float:
        """Return the bias by the temperature at the next `n` samples, rad/s, shape (n, 1) unless it is constant."""
        thermal = self.profile.temperature
        begin, self._index = self._index, self._index + n
        coefficient = thermal.bias_coefficient_dph_per_c * DPH
        if not thermal.warm_up_rise_c:
            return coefficient * (thermal.ambient_c - thermal.reference_c)
        age = np.arange(begin, self._index) / self.sample_rate
        temperature = thermal.ambient_c - thermal.warm_up_rise_c * np.expm1(-age / thermal.warm_up_time_constant_s)
        self.temperature = float(temperature[-1]) if n else self.temperature
        change: NDArray[np.float64] = temperature[:, np.newaxis] - thermal.reference_c
        return coefficient * change
