"""What the firmware needs from the board it runs on.

A board support package (or the emulator's plant) subclasses these. Integers only, in the wire's units: rate
2^-10 deg/h, angle 0.1 arcsec, angular speed 0.1 arcsec/s, temperature 1/256 degree Celsius, time in microseconds of
the board's own clock, which starts at 0 with the board.
"""


class Board:
    """What both devices have."""

    model = ""  # printable ASCII, at most 16 characters
    serial_number = ""  # likewise
    boot_count = 0

    def self_test(self) -> int:
        """Return the bits of failed tests, see SELF_TEST_RESULT. Moves nothing."""
        raise NotImplementedError

    def self_test_us(self) -> int:
        """Return how long the self-test takes."""
        raise NotImplementedError


class GyroBoard(Board):
    """The gyro: a sampler that fills a buffer by itself, and slow sensors."""

    n_axes = 1
    sample_rate_millihz = 0
    range_dph = 0

    def start_sampling(self, now_us: int) -> None:
        """Empty the buffer and take the first sample, number 0, at `now_us`."""
        raise NotImplementedError

    def stop_sampling(self) -> None:
        """Stop the sampler."""
        raise NotImplementedError

    def sample_time_us(self, index: int) -> int:
        """Return the instant of sample `index` since `start_sampling`."""
        raise NotImplementedError

    def read_samples(self, n: int) -> bytes:
        """Return the next `n` samples: int32 little-endian, all axes of a sample together.

        The caller asks only for samples whose instant has come.
        """
        raise NotImplementedError

    def status(self) -> int:
        """Return the status bits 0 to 3 and 5 of SAMPLES for the samples of the last `read_samples`."""
        raise NotImplementedError

    def temperature(self) -> int:
        """Return the temperature at the last `read_samples`."""
        raise NotImplementedError

    def tilt(self) -> tuple:  # type: ignore[type-arg]  # MicroPython has no tuple[int, int]
        """Return (tilt_x, tilt_y) at the last `read_samples`."""
        raise NotImplementedError

    def specific_force(self) -> tuple:  # type: ignore[type-arg]  # as tilt
        """Return what three accelerometers along the gyro's axes read at the last `read_samples`, each in 1e-6 g.

        At rest the upward axis reads +1 g.
        """
        raise NotImplementedError


class StageBoard(Board):
    """The stage: two axes, 0 azimuth and 1 elevation, each with a position drive, an encoder and switches.

    Encoder counts are relative to where the axis stood at power-up; homing finds the reference.
    """

    azimuth_limits = (0, 0)  # widest soft limits, about the reference
    elevation_limits = (0, 0)
    cable_wrap = 0  # either side of the reference, azimuth
    max_speed = 0
    max_acceleration = 0
    stop_deceleration = 0  # how hard STOP and a fault may brake an axis
    control_period_us = 10_000  # the firmware commands the drives this often while the stage is not at rest

    def drive(self, axis: int, position: int, now_us: int) -> None:
        """Command the drive of an axis to `position`, in counts since power-up; it follows within a control period."""
        raise NotImplementedError

    def encoder(self, axis: int, now_us: int) -> int:
        """Return the encoder count of an axis since power-up."""
        raise NotImplementedError

    def reference_side(self, axis: int, now_us: int) -> int:
        """Return on which side of the reference edge the axis stands: -1 below, +1 at or above it."""
        raise NotImplementedError

    def overload(self, axis: int, now_us: int) -> bool:
        """Return whether the drive reports that its motor cannot follow: this tells a stall from a dead encoder."""
        raise NotImplementedError

    def limit_switch(self, axis: int, now_us: int) -> bool:
        """Return whether a limit switch of the axis is closed."""
        raise NotImplementedError

    def e_stop(self, now_us: int) -> bool:
        """Return whether the emergency stop is pressed."""
        raise NotImplementedError
