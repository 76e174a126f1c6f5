"""The plant behind the boards that the firmware runs on: SI units inside, integers in the wire's units outside.

World time is in microseconds and the same for all devices; a board's clock starts at its own start, `epoch_us`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_device.firmware.hardware import GyroBoard, StageBoard
from sim_device.plant.earth import project
from sim_device.plant.gyro import ARCSEC, DPH, Gyro
from sim_device.plant.stage import Stage

RATE_LSB = DPH / 1024  #: rad/s in one count of rate
ANGLE_LSB = ARCSEC / 10  #: rad in one count of angle
NOISE_STEP_S = 600  #: see `SimGyroBoard.start_sampling`

NOT_READY, SATURATED, SENSOR_FAULT = 1, 2, 4  #: status bits of SAMPLES


def _counts(arcsec: float) -> int:
    return round(arcsec * 10)


class SimGyroBoard(GyroBoard):
    """The gyro's board.

    Parameters
    ----------
    gyro
        What it samples.
    stage
        What the gyro stands on; must have been driven up to the instant of each sample that is read.
    serial_number
        As answered to HELLO.
    tilt_rng, accelerometer_rng
        Draw the noise of the tilt sensors and of the accelerometers.
    epoch_us, boot_count
        When this board started, in world time, and for which time.

    """

    def __init__(
        self,
        gyro: Gyro,
        stage: Stage,
        *,
        serial_number: str,
        tilt_rng: np.random.Generator,
        accelerometer_rng: np.random.Generator,
        epoch_us: int,
        boot_count: int,
    ) -> None:
        self.gyro = gyro
        self.model = gyro.profile.model
        self.serial_number = serial_number
        self.boot_count = boot_count
        self.n_axes = gyro.profile.n_axes
        self.sample_rate_millihz = round(gyro.profile.sample_rate_hz * 1000)
        self.range_dph = round(gyro.profile.range_dph)
        self.self_test_failures = 0  #: fault hook: bits of SELF_TEST_RESULT
        self.sensor_fault = False  #: fault hook: the gyro's supervision trips
        self.newest_block_us = -1  #: board time of the first sample of the last block read
        self.newest_block_samples = 0
        self._stage = stage
        self._tilt_rng = tilt_rng
        self._accelerometer_rng = accelerometer_rng
        self._stood: tuple[float, ...] = ()  # where the stage last stood when the vertical was looked for
        self._up = np.zeros(3)
        self._epoch_us = epoch_us
        self._start_us = 0
        self._next = 0
        self._taken = 0

    def self_test(self) -> int:
        """Return the bits of failed tests."""
        return self.self_test_failures

    def self_test_us(self) -> int:
        """Return how long the self-test takes."""
        return 500_000

    def start_sampling(self, now_us: int) -> None:
        """Take the first sample at `now_us`.

        The noise has gone on since the board's start, but in steps of ten minutes, so that a stream which starts a
        moment sooner or later, as after another homing or over another line, meets the same noise.
        """
        per_step = NOISE_STEP_S * self.sample_rate_millihz // 1000
        begin = now_us // (NOISE_STEP_S * 1_000_000) * per_step
        if begin > self._taken:
            self.gyro.skip(begin - self._taken)
            self._taken = begin
        self._start_us = now_us
        self._next = 0
        self.newest_block_us = -1

    def stop_sampling(self) -> None:
        """Stop the sampler."""
        self.newest_block_us = -1

    def sample_time_us(self, index: int) -> int:
        """Return the instant of sample `index` since `start_sampling`."""
        return self._start_us + index * 1_000_000_000 // self.sample_rate_millihz

    def read_samples(self, n: int) -> bytes:
        """Return the next `n` samples: int32 little-endian, all axes of a sample together."""
        self.newest_block_us = self.sample_time_us(self._next)
        self.newest_block_samples = n
        period_us = 1e9 / self.sample_rate_millihz
        begin_us = self._epoch_us + self._start_us + (self._next - 1) * period_us
        self._next += n
        self._taken += n
        if self._stage.rest_since_us() <= begin_us:
            angles = [axis.true_angle(int(begin_us)) for axis in self._stage.axes]
            rate = self.gyro.measure_at_rest(angles[0], angles[1], n)
        else:
            rate = self._measure_moving(begin_us + period_us * np.arange(n + 1.0), period_us)
        limits = np.iinfo(np.int32)
        return np.clip(np.rint(rate / RATE_LSB), limits.min, limits.max).astype("<i4").tobytes()

    def _measure_moving(self, edges_us: NDArray[np.float64], period_us: float) -> NDArray[np.float64]:
        """Measure the mean over each sample interval, so that the integral of the rate is the angle turned."""
        azimuth, elevation = (axis.true_angles(edges_us) for axis in self._stage.axes)
        return self.gyro.measure(
            (azimuth[1:] + azimuth[:-1]) / 2,
            (elevation[1:] + elevation[:-1]) / 2,
            azimuth_rate=np.diff(azimuth) / (period_us * 1e-6),
            elevation_rate=np.diff(elevation) / (period_us * 1e-6),
        )

    def status(self) -> int:
        """Return the status bits for the samples of the last `read_samples`."""
        ready = self.newest_block_us >= self.gyro.profile.turn_on_time_s * 1e6
        return (0 if ready else NOT_READY) | SATURATED * self.gyro.saturated | SENSOR_FAULT * self.sensor_fault

    def temperature(self) -> int:
        """Return the temperature at the last `read_samples`, 1/256 degree Celsius."""
        return round(self.gyro.temperature * 256)

    def tilt(self) -> tuple[int, int]:
        """Return (tilt_x, tilt_y) as the sensors read them, 0.1 arcsec."""
        noise = self.gyro.profile.tilt_noise_arcsec * ARCSEC
        tilt_x, tilt_y = self.gyro.site.tilt
        if noise:
            tilt_x += noise * self._tilt_rng.standard_normal()
            tilt_y += noise * self._tilt_rng.standard_normal()
        return round(tilt_x / ANGLE_LSB), round(tilt_y / ANGLE_LSB)

    def specific_force(self) -> tuple[int, int, int]:
        """Return what the accelerometers read at the middle of the last `read_samples`, 1e-6 g each."""
        profile = self.gyro.profile.accelerometers
        middle_us = int(
            self._epoch_us + self.newest_block_us + 5e8 * self.newest_block_samples / self.sample_rate_millihz
        )
        stands = tuple(axis.true_angle(middle_us) for axis in self._stage.axes)
        if stands != self._stood:
            self._stood = stands
            self._up = project(self.gyro.site, np.eye(3), stands[0], stands[1]).up[0]
        noise = profile.velocity_random_walk_mg_per_sqrt_hz * math.sqrt(
            self.sample_rate_millihz / 1000 / max(1, self.newest_block_samples)
        )
        read = self._up * 1e3 + profile.bias_mg + noise * self._accelerometer_rng.standard_normal(3)
        x, y, z = np.rint(read * 1e3)
        return int(x), int(y), int(z)


class SimStageBoard(StageBoard):
    """The stage's board: drives, encoders, switches and the emergency stop of one stage."""

    def __init__(self, stage: Stage, *, serial_number: str, epoch_us: int, boot_count: int) -> None:
        profile = stage.profile
        self.stage = stage
        self.model = profile.model
        self.serial_number = serial_number
        self.boot_count = boot_count
        azimuth, elevation = (_counts(axis.limit_deg * 3600) for axis in (profile.azimuth, profile.elevation))
        self.azimuth_limits = (-azimuth, azimuth)
        self.elevation_limits = (-elevation, elevation)
        self.cable_wrap = _counts(profile.cable_wrap_deg * 3600)
        self.max_speed = _counts(profile.max_speed_deg_per_s * 3600)
        self.max_acceleration = _counts(profile.max_acceleration_deg_per_s2 * 3600)
        self.stop_deceleration = _counts(profile.stop_deceleration_deg_per_s2 * 3600)
        self.self_test_failures = 0  #: fault hook: bits of SELF_TEST_RESULT
        self._epoch_us = epoch_us
        self._motor_zero = [axis.motor_angle(epoch_us) for axis in stage.axes]
        self._encoder_zero = [axis.encoder(epoch_us) for axis in stage.axes]

    def self_test(self) -> int:
        """Return the bits of failed tests."""
        return self.self_test_failures

    def self_test_us(self) -> int:
        """Return how long the self-test takes."""
        return 300_000

    def drive(self, axis: int, position: int, now_us: int) -> None:
        """Command the drive of an axis to `position`, in counts since power-up."""
        motor = self._motor_zero[axis] + position * ANGLE_LSB
        self.stage.axes[axis].drive(motor, self._epoch_us + now_us, self.control_period_us)

    def encoder(self, axis: int, now_us: int) -> int:
        """Return the encoder count of an axis since power-up."""
        return round((self.stage.axes[axis].encoder(self._epoch_us + now_us) - self._encoder_zero[axis]) / ANGLE_LSB)

    def reference_side(self, axis: int, now_us: int) -> int:
        """Return -1 below the reference edge, +1 at or above it."""
        return 1 if self.stage.axes[axis].above_reference(self._epoch_us + now_us) else -1

    def overload(self, axis: int, now_us: int) -> bool:  # noqa: ARG002 - a drive's report has no history
        """Return whether the drive cannot follow."""
        return self.stage.axes[axis].overload()

    def limit_switch(self, axis: int, now_us: int) -> bool:
        """Return whether a limit switch of the axis is closed."""
        return self.stage.axes[axis].limit_switch(self._epoch_us + now_us)

    def e_stop(self, now_us: int) -> bool:  # noqa: ARG002 - the button has no history
        """Return whether the emergency stop is pressed."""
        return self.stage.e_stop
