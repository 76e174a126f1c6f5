"""Ideal boards for the firmware's tests: each axis stands exactly where its drive was sent, unless told otherwise."""

import struct

from sim_device.firmware.hardware import GyroBoard, StageBoard

DEG = 36_000


class FakeGyroBoard(GyroBoard):
    """A gyro whose sample k of axis j reads 1000 k + j."""

    model = "fake gyro"
    serial_number = "G-1"
    boot_count = 3
    sample_rate_millihz = 250_000
    range_dph = 5000

    def __init__(self, n_axes: int = 1) -> None:
        self.n_axes = n_axes
        self.started_us = 0
        self.n_starts = 0
        self.sampling = False
        self.n_read = 0
        self.flags = 0

    def self_test(self) -> int:
        """Report a resonator drive that has failed."""
        return 1 << 2

    def self_test_us(self) -> int:
        """Take 0.7 s."""
        return 700_000

    def start_sampling(self, now_us: int) -> None:
        """Begin at sample 0."""
        self.started_us = now_us
        self.n_starts += 1
        self.sampling = True
        self.n_read = 0

    def stop_sampling(self) -> None:
        """Stop."""
        self.sampling = False

    def sample_time_us(self, index: int) -> int:
        """Count samples from the start."""
        return self.started_us + index * 1_000_000_000 // self.sample_rate_millihz

    def read_samples(self, n: int) -> bytes:
        """Give the next samples."""
        assert self.sampling
        first = self.n_read
        self.n_read += n
        return b"".join(
            struct.pack("<i", 1000 * index + axis) for index in range(first, first + n) for axis in range(self.n_axes)
        )

    def status(self) -> int:
        """Give the flags set by the test."""
        return self.flags

    def temperature(self) -> int:
        """Give -5 degrees Celsius."""
        return -5 * 256

    def tilt(self) -> tuple[int, int]:
        """Give 12 and -34 arcsec."""
        return (120, -340)


class FakeStageBoard(StageBoard):
    """A stage that was switched on at some position about its reference, and can be made to misbehave.

    An axis is frozen in place while `stuck`; its encoder repeats `frozen`; `error` is added to its count. The drives
    follow at once and exactly, so what `path` records is where the stage has been.
    """

    model = "fake stage"
    serial_number = "S-1"
    boot_count = 4
    azimuth_limits = (-380 * DEG, 380 * DEG)
    elevation_limits = (-95 * DEG, 95 * DEG)
    cable_wrap = 400 * DEG
    max_speed = 18 * DEG
    max_acceleration = 9 * DEG
    stop_deceleration = 9 * DEG

    def __init__(self, azimuth: int = 0, elevation: int = 0) -> None:
        self.power_up = (azimuth, elevation)
        self.axis = [0, 0]  # where each stands, since power-up
        self.stuck = [False, False]
        self.overloaded = [False, False]
        self.frozen: list[int | None] = [None, None]
        self.error = [0, 0]
        self.away = [0, 0]  # speed at which a drive runs off by itself, counts a second
        self.switch = [False, False]
        self.pressed = False
        self.dead_side: int | None = None  # what a dead reference sensor tells
        self.path: list[tuple[int, int, int]] = []  # (time, axis, position about the reference)

    def position(self, axis: int) -> int:
        """Return where an axis truly stands about its reference."""
        return self.axis[axis] + self.power_up[axis]

    def self_test(self) -> int:
        """Find nothing wrong."""
        return 0

    def self_test_us(self) -> int:
        """Take 0.5 s."""
        return 500_000

    def drive(self, axis: int, position: int, now_us: int) -> None:
        """Go there at once, unless stuck or running off."""
        if self.away[axis]:
            self.axis[axis] += self.away[axis] * self.control_period_us // 1_000_000
        elif not self.stuck[axis]:
            self.axis[axis] = position
        self.path.append((now_us, axis, self.position(axis)))

    def encoder(self, axis: int, now_us: int) -> int:
        """Count without error, unless told otherwise."""
        frozen = self.frozen[axis]
        return (self.axis[axis] if frozen is None else frozen) + self.error[axis]

    def reference_side(self, axis: int, now_us: int) -> int:
        """Tell the side without error, unless dead."""
        return self.dead_side or (-1 if self.position(axis) < 0 else 1)

    def overload(self, axis: int, now_us: int) -> bool:
        """Give what the test set."""
        return self.overloaded[axis]

    def limit_switch(self, axis: int, now_us: int) -> bool:
        """Give what the test set."""
        return self.switch[axis]

    def e_stop(self, now_us: int) -> bool:
        """Give what the test set."""
        return self.pressed
