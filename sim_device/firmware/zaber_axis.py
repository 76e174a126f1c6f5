"""One axis of the emulated Zaber controller: homing, moves one after the other, and the flags that they leave.

Positions are in microsteps of 1 arcsec about the reference, which is 10 counts of the board; times in microseconds.
Speeds and accelerations are in the controller's own units, see ``docs/zaber.md``, section 2.
"""

from sim_device.firmware.axis import (
    E_STOP,
    ENCODER,
    IN_POSITION,
    LIMIT_SWITCH,
    RUNAWAY,
    STALL,
    Axis,
    Homing,
)
from sim_device.firmware.hardware import StageBoard

COUNTS = 10  # of the board, in a microstep
MICROSTEPS_PER_DEG = 3600

_SETTLE_US = 1_000_000
_HOMING_MARGIN = 360_000  # beyond the range, 10 deg

FLAGS = {E_STOP: "FH", STALL: "FS", RUNAWAY: "FR", ENCODER: "FQ", LIMIT_SWITCH: "WL"}
_DRIVER_OFF = ("FH", "FR", "FQ", "FO")
_STOPPED = ("FH", "FR", "FQ", "FO", "FS", "WL")
_LOSE_REFERENCE = ("FR", "FQ")
ORDER = ("FH", "FO", "FQ", "FR", "FS", "WL", "WR", "NI")  # the gravest first


def speed_units(counts: int) -> int:
    """Return a speed in counts/s in the controller's units."""
    return counts * 16384 // (COUNTS * 10000)


def acceleration_units(counts: int) -> int:
    """Return an acceleration in counts/s^2 in the controller's units."""
    return max(1, counts * 16384 // (COUNTS * 100_000_000))


def _speed(units: int) -> int:
    return max(1, units * COUNTS * 10000 // 16384)


def _acceleration(units: int) -> int:
    return max(1, units * COUNTS * 100_000_000 // 16384)


class ZaberAxis:
    """An axis with its settings.

    Attributes
    ----------
    settings : dict
        Name to value, of those that can be set.
    busy : bool
        Whether it moves.
    """

    def __init__(self, board: StageBoard, index: int) -> None:
        self._board = board
        self._index = index
        self._axis = Axis(board, index)
        lowest, highest = board.elevation_limits if index else board.azimuth_limits
        self._widest = (-(-lowest // COUNTS), highest // COUNTS)
        self._top_speed = speed_units(board.max_speed)
        self._top_acceleration = acceleration_units(board.max_acceleration)
        self.settings = {
            "limit.min": self._widest[0],
            "limit.max": self._widest[1],
            "maxspeed": self._top_speed,
            "accel": self._top_acceleration,
        }
        self.busy = False
        self._flags = ["WR"]
        self._homing: "Homing | None" = None
        self._next: "tuple[int, ...] | None" = None  # (target, speed) once it has come to rest, or () for homing
        self._suspected = False

    # what it tells

    def position(self, now_us: int) -> int:
        """Return where it stands."""
        return (self._axis.position(now_us) + COUNTS // 2) // COUNTS

    @property
    def flags(self) -> list:  # type: ignore[type-arg]  # MicroPython has no list[str]
        """Flags that are set, the gravest first."""
        return [flag for flag in ORDER if flag in self._flags]

    @property
    def homed(self) -> bool:
        """Whether it has its reference."""
        return "WR" not in self._flags

    @property
    def disabled(self) -> bool:
        """Whether its driver is off."""
        return any(flag in _DRIVER_OFF for flag in self._flags)

    def allowed(self, name: str, value: int) -> bool:
        """Return whether a setting may have a value."""
        settings = self.settings
        ranges = {
            "limit.min": (self._widest[0], settings["limit.max"]),
            "limit.max": (settings["limit.min"], self._widest[1]),
            "maxspeed": (1, self._top_speed),
            "accel": (1, self._top_acceleration),
        }
        lowest, highest = ranges[name]
        return lowest <= value <= highest

    # commands

    def home(self, now_us: int) -> None:
        """Begin homing; a motion under way is brought to rest first."""
        self._raise("WR")
        if self.busy:
            self._interrupt((), now_us)
            return
        self._leave(now_us)
        self._search(now_us)

    def _search(self, now_us: int) -> None:
        board = self._board
        reach = 2 * board.cable_wrap if self._index == 0 else board.elevation_limits[1] - board.elevation_limits[0]
        speed, acceleration = _speed(self.settings["maxspeed"]), _acceleration(self.settings["accel"])
        self._homing = Homing(board, self._index, self._axis, reach + _HOMING_MARGIN, speed, acceleration, now_us)

    def move(self, target: int, speed: int, now_us: int) -> None:
        """Leave for a target; a motion under way is brought to rest first."""
        if self.busy:
            self._interrupt((target, speed), now_us)
            return
        self._leave(now_us)
        self._go(target, speed, now_us)

    def stop(self, now_us: int) -> None:
        """Come to rest."""
        if self.busy:
            self._interrupt(None, now_us)

    def _interrupt(self, following: "tuple[int, ...] | None", now_us: int) -> None:
        self._raise("NI")
        self._homing = None
        self._next = following
        self._axis.brake(now_us)

    def clear(self) -> None:
        """Forget what may be forgotten; a driver that is off, and a reference that is lost, stay so."""
        self._flags = [flag for flag in self._flags if flag == "WR" or flag in _DRIVER_OFF]

    def switch(self, now_us: int, *, enabled: bool) -> bool:
        """Switch the driver on or off; return whether it is as wanted now."""
        if not enabled:
            self.stop(now_us)
            self._raise("FO")
            return True
        if self._board.e_stop(now_us):
            return False
        if not self.busy:
            self._axis.observe(now_us)
            if "FQ" in self._flags:
                self._axis.realign()
            self._axis.rest()
        self._flags = [flag for flag in self._flags if flag not in _DRIVER_OFF]
        return True

    # work

    def tick(self, now_us: int) -> None:
        """Supervise the axis, and take it further."""
        if self.busy:
            self._advance(now_us)
        elif self._board.e_stop(now_us):
            self._raise("FH")
        elif self.homed and not self.disabled and self._axis.disturbed(now_us):
            self._notice(now_us)
        else:
            self._suspected = False

    def _notice(self, now_us: int) -> None:
        """Tell at a second look an axis that runs from an encoder that has jumped."""
        if self._suspected:
            self._trip(RUNAWAY if self._axis.runs else ENCODER, now_us)
            self._axis.rest()
        self._suspected = not self._suspected

    def _advance(self, now_us: int) -> None:
        axis = self._axis
        if any(flag in _STOPPED for flag in self._flags):
            axis.observe(now_us)
            if axis.lost and "FQ" not in self._flags:
                axis.hold(now_us)
        else:
            fault = axis.check(now_us)
            if self._board.e_stop(now_us):
                fault = E_STOP
            if fault:
                self._trip(fault, now_us)
        if self._homing is not None:
            self._advance_homing(self._homing, now_us)
        elif axis.arrived(now_us) and self._settled(now_us):
            self._arrive(now_us)
        if self.busy:
            axis.drive(now_us)

    def _advance_homing(self, homing: Homing, now_us: int) -> None:
        homing.step(now_us)
        if homing.failed:
            self._trip(STALL, now_us)
        elif homing.done and self._settled(now_us):
            self._axis.offset = homing.edge
            self._flags.remove("WR")
            self._homing = None
            self._rest()

    def _settled(self, now_us: int) -> bool:
        """Return whether the encoder is where the profile ended; one that does not get there has stalled."""
        axis = self._axis
        if not axis.arrived(now_us):
            return False
        if "FQ" in self._flags or abs(axis.lag) <= IN_POSITION:
            return True
        if now_us - axis.profile.end_us <= _SETTLE_US:
            return False
        self._trip(axis.diagnose(now_us), now_us)
        axis.hold(now_us)
        return False

    def _arrive(self, now_us: int) -> None:
        """Come to rest, or set out for what was asked for meanwhile."""
        if self._next is None:
            self._rest()
            return
        following, self._next = self._next, None
        if following:
            self._go(following[0], following[1], now_us)
        else:
            self._search(now_us)

    def _go(self, target: int, speed: int, now_us: int) -> None:
        counts = self._axis.offset + target * COUNTS
        self._axis.go(counts, _speed(speed), _acceleration(self.settings["accel"]), now_us)

    def _leave(self, now_us: int) -> None:
        """Get ready to set out; what was only of the last motion is forgotten."""
        self._flags = [flag for flag in self._flags if flag not in ("FS", "WL", "NI")]
        self._axis.start(now_us)
        self.busy = True

    def _rest(self) -> None:
        self.busy = False
        self._suspected = False
        self._axis.rest()

    def _trip(self, fault: int, now_us: int) -> None:
        """Note a fault and come to rest."""
        flag = FLAGS[fault]
        self._raise(flag)
        if flag in _LOSE_REFERENCE:
            self._raise("WR")
        self._homing = self._next = None
        self._axis.brake(now_us)

    def _raise(self, flag: str) -> None:
        if flag not in self._flags:
            self._flags.append(flag)
