"""A two-axis rotation stage as physics: drives that follow commanded positions, encoders, switches, and their errors.

An axis has three angles. The *motor* angle is where the drive stands, and what the encoder measures. The *load* angle
follows it through the backlash. The *true* angle is the load angle with the positioning error, and is what the gyro,
the reference edge and the switches meet. All are in rad from the reference, times in microseconds of the world.
"""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from sim_device.plant.profile import AxisProfile, StageProfile

ARCSEC = math.radians(1.0) / 3600.0  #: rad in one arc second
HARMONICS = (1, 2, 4)  #: a turn, of the periodic positioning error
SETTLING_ANGLE = math.radians(0.5)  #: travel over which the error of a new move takes the place of the last one's
DRIVE_RESERVE = 1.5  #: greatest speed of a drive over the greatest speed of the stage
KEPT_KNOTS = 20_000  #: of the trajectory, at least half of them: 100 s of motion


class StageAxis:
    """One axis. Its trajectory is a list of knots, straight between them, at rest after the last one.

    Parameters
    ----------
    profile
        Its limits and errors.
    max_speed
        Of its drive, rad/s.
    rng
        Draws the angle at power-up and the errors.

    """

    def __init__(self, profile: AxisProfile, max_speed: float, rng: np.random.Generator) -> None:
        self.profile = profile
        self._rng = rng
        self._max_speed = max_speed
        self._stop = math.radians(profile.mechanics_deg)
        self._switch = math.radians(profile.switch_deg)
        self._play = profile.backlash_arcsec * ARCSEC / 2
        amplitude = profile.positioning_error_arcsec * ARCSEC * math.sqrt(2 / len(HARMONICS))
        self._harmonics = [(n, amplitude, rng.uniform(0, 2 * math.pi)) for n in HARMONICS]
        self._move_error = 0.0
        self._next_move_error = 0.0
        start = rng.uniform(-1, 1) * math.radians(profile.power_up_deg)
        self._times = [0]
        self._motor = [start]
        self._load = [start]
        self._true = [start + self._positioning_error(start)]
        self._stalled = False
        self._running_away = False
        self._blocked = False
        self._frozen_encoder: float | None = None
        self._encoder_offset = 0.0
        self._stuck_switch: bool | None = None

    def drive(self, motor: float, time_us: int, period_us: int) -> None:
        """Command the drive to `motor`; it gets there within `period_us`, or later at its greatest speed."""
        if not self._running_away:
            self._go(self.motor_angle(time_us) if self._stalled else motor, time_us, period_us)
            self._blocked = abs(motor - self._motor[-1]) > ARCSEC

    def overload(self) -> bool:
        """Return whether the drive cannot follow what it was told."""
        return self._blocked

    def motor_angle(self, time_us: int) -> float:
        """Return the motor angle at an instant not before the kept trajectory."""
        return self._at(self._motor, time_us)

    def true_angle(self, time_us: int) -> float:
        """Return the true angle at an instant not before the kept trajectory."""
        return self._at(self._true, time_us)

    def encoder(self, time_us: int) -> float:
        """Return what the encoder reads, in rad from the reference, quantised to its resolution."""
        if self._frozen_encoder is not None:
            return self._frozen_encoder
        angle = self.motor_angle(time_us) + self._encoder_offset
        lsb = self.profile.encoder_resolution_arcsec * ARCSEC
        return math.floor(angle / lsb + 0.5) * lsb if lsb else angle

    def above_reference(self, time_us: int) -> bool:
        """Return whether the axis stands at or above its reference edge."""
        return self.true_angle(time_us) >= 0

    def limit_switch(self, time_us: int) -> bool:
        """Return whether a limit switch is closed."""
        if self._stuck_switch is not None:
            return self._stuck_switch
        return abs(self.true_angle(time_us)) >= self._switch

    def rest_since_us(self) -> int:
        """Return the instant of the last knot: at rest after it, unless commanded again."""
        return self._times[-1]

    def true_angles(self, times_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the true angle at rising instants, shape (n,).

        Raises
        ------
        ValueError
            If the trajectory is no longer kept so far back.

        """
        if times_us[0] < self._times[0] and self._times[0] > 0:
            raise ValueError(f"the trajectory is kept from {self._times[0]} us on, asked for {times_us[0]:.0f} us")
        first = max(bisect_right(self._times, times_us[0]) - 1, 0)
        return np.interp(times_us, self._times[first:], self._true[first:])

    # Faults, for tests

    def stall(self, time_us: int, *, stalled: bool = True) -> None:
        """Block the axis where it stands, or set it free."""
        self._hold(time_us)
        self._stalled = stalled
        self._blocked = False

    def run_away(self, time_us: int, speed: float) -> None:
        """Make the drive run at `speed` (rad/s), whatever it is told, until it hits its stop; 0 ends the fault."""
        self._hold(time_us)
        self._running_away = speed != 0
        if not self._running_away:
            return
        start, stop = self._motor[-1], math.copysign(self._stop, speed)
        n_knots = math.ceil(abs(stop - start) / math.radians(1.0))  # close enough for the errors along the way
        for motor in np.linspace(start, stop, n_knots + 1)[1:].tolist():
            self._knot(time_us + round(abs((motor - start) / speed) * 1e6), motor)

    def freeze_encoder(self, time_us: int, *, frozen: bool = True) -> None:
        """Freeze the encoder at what it reads now, or release it."""
        self._frozen_encoder = self.encoder(time_us) if frozen else None

    def jump_encoder(self, angle: float) -> None:
        """Shift the encoder by `angle`, rad."""
        self._encoder_offset += angle

    def stick_limit_switch(self, *, closed: bool | None) -> None:
        """Make the limit switch read `closed` for ever, or work again if None."""
        self._stuck_switch = closed

    # The trajectory

    def _go(self, motor: float, time_us: int, period_us: int) -> None:
        starts_from_rest = time_us > self._times[-1]
        self._hold(time_us)
        motor = min(max(motor, -self._stop), self._stop)
        distance = abs(motor - self._motor[-1])
        if distance == 0:
            return
        if starts_from_rest:
            self._next_move_error = self.profile.repeatability_arcsec * ARCSEC * self._rng.standard_normal()
        self._knot(time_us + max(period_us, round(distance / self._max_speed * 1e6)), motor)

    def _hold(self, time_us: int) -> None:
        """End the trajectory at `time_us`, at the place it then has."""
        if time_us > self._times[-1]:
            self._append(time_us, self._motor[-1], self._load[-1], self._true[-1])
        elif time_us < self._times[-1]:
            here = self._at(self._motor, time_us), self._at(self._load, time_us), self._at(self._true, time_us)
            keep = bisect_right(self._times, time_us)
            for values in (self._times, self._motor, self._load, self._true):
                del values[keep:]
            if self._times and self._times[-1] == time_us:
                return
            self._append(time_us, *here)

    def _knot(self, time_us: int, motor: float) -> None:
        load = min(max(self._load[-1], motor - self._play), motor + self._play)
        share = min(1.0, abs(load - self._load[-1]) / SETTLING_ANGLE)
        self._move_error += share * (self._next_move_error - self._move_error)
        self._append(time_us, motor, load, load + self._positioning_error(load) + self._move_error)

    def _append(self, time_us: int, motor: float, load: float, true: float) -> None:
        if len(self._times) >= KEPT_KNOTS:
            for values in (self._times, self._motor, self._load, self._true):
                del values[: KEPT_KNOTS // 2]
        self._times.append(time_us)
        self._motor.append(motor)
        self._load.append(load)
        self._true.append(true)

    def _positioning_error(self, angle: float) -> float:
        return sum(amplitude * math.sin(n * angle + phase) for n, amplitude, phase in self._harmonics)

    def _at(self, values: list[float], time_us: int) -> float:
        times = self._times
        if time_us >= times[-1]:
            return values[-1]
        after = bisect_right(times, time_us)
        if after == 0:
            return values[0]
        share = (time_us - times[after - 1]) / (times[after] - times[after - 1])
        return values[after - 1] + share * (values[after] - values[after - 1])


class Stage:
    """The stage of a profile: two axes and an emergency stop button."""

    def __init__(self, profile: StageProfile, seed: np.random.SeedSequence) -> None:
        self.profile = profile
        speed = DRIVE_RESERVE * math.radians(profile.max_speed_deg_per_s)
        children = seed.spawn(2)
        self.azimuth = StageAxis(profile.azimuth, speed, np.random.default_rng(children[0]))
        self.elevation = StageAxis(profile.elevation, speed, np.random.default_rng(children[1]))
        self.axes = (self.azimuth, self.elevation)
        self.e_stop = False  #: whether the button is pressed

    def rest_since_us(self) -> int:
        """Return since when both axes have been at rest, or when the motion commanded so far will end."""
        return max(axis.rest_since_us() for axis in self.axes)
