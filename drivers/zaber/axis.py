"""One axis of a Zaber stage: its units and limits, and what its answers mean."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, radians

from drivers.errors import ProtocolError
from drivers.limits import AxisLimits
from drivers.protocol.zaber import (
    ACCELERATION_UNITS,
    DOUBTFUL,
    NOT_HOMED,
    VELOCITY_UNITS,
    WARNINGS,
    Reply,
    integers,
)
from drivers.zaber.identity import Device
from drivers.zaber.line import Line, Target
from drivers.zaber.options import KNOWN_UNITS_PER_DEG, AxisOptions

TOLERANCE = radians(0.005)  #: of a position reached, and of one that rests; or 2 microsteps if those are more


@dataclass(frozen=True, slots=True)
class AxisReport:
    """What one answer to a poll tells."""

    position: float  #: rad
    busy: bool
    homed: bool | None  #: None where a graver flag hides it
    fault: str  #: in words with its flag, ``""`` if none


class ZaberAxis:
    """An axis as the driver sees it. Angles in rad outside, microsteps on the line."""

    def __init__(self, line: Line, options: AxisOptions) -> None:
        self.options = options
        self.target = Target(options.device, options.axis)
        self._line = line
        self._units = 0.0  # microsteps a rad, with the sign
        self._zero = radians(options.position_zero_deg)
        self._own_speed = 0  # maxspeed, in the device's units
        self._has_velocity = False  # whether `move abs` takes a velocity

    @property
    def name(self) -> str:
        """For messages."""
        return f"the {self.options.name} axis ({self._line.describe(self.target)}) on {self._line.name}"

    @property
    def half_unit(self) -> float:
        """Half a microstep, rad."""
        return abs(0.5 / self._units)

    @property
    def tolerance(self) -> float:
        """How near to a place the axis counts as there, rad."""
        return max(TOLERANCE, 4 * self.half_unit)

    def meet(self, device: Device) -> AxisLimits:
        """Read what the axis of a device can do.

        Raises
        ------
        ValueError
            If its microsteps a degree are neither configured nor known.
        """
        per_deg = self.options.units_per_deg or KNOWN_UNITS_PER_DEG.get(device.device_id)
        if per_deg is None:
            raise ValueError(
                f"how far a microstep of {self.name} goes is not known: set {self.options.name}_units_per_deg to the "
                f"microsteps of one degree; for this device, id {device.device_id}, look in its data sheet"
            )
        self._units = degrees(per_deg)  # microsteps a rad
        self._has_velocity = device.firmware >= (7, 25)
        lowest, highest, self._own_speed, acceleration = (
            self._number(setting) for setting in ("limit.min", "limit.max", "maxspeed", "accel")
        )
        ends = sorted((self.angle(lowest), self.angle(highest)))
        return AxisLimits(
            ends[0],
            ends[1],
            self._own_speed / VELOCITY_UNITS / abs(self._units),
            acceleration / ACCELERATION_UNITS / abs(self._units),
        )

    def _number(self, setting: str) -> int:
        reply = self._line.order(self.target, f"get {setting}")
        found = integers(reply.data, 1)
        if found is None:
            raise ProtocolError(f"{self.name} answered {setting} with {reply.data!r}, expected a whole number")
        return found[0]

    def angle(self, position: int) -> float:
        """Return a position in microsteps as an angle."""
        return self._zero + position / self._units

    def position(self, angle: float) -> int:
        """Return an angle as a position in microsteps."""
        return round((angle - self._zero) * self._units)

    def move_command(self, angle: float, speed: float) -> str:
        """Return the command that takes the axis to `angle` at `speed`, rad/s.

        Raises
        ------
        ValueError
            If the device's firmware cannot go slower than its ``maxspeed``.
        """
        velocity = max(1, round(speed * abs(self._units) * VELOCITY_UNITS))
        command = f"move abs {self.position(angle)}"
        if velocity >= self._own_speed:
            return command
        if not self._has_velocity:
            raise ValueError(
                f"{self.name} has a firmware older than 7.25, which moves at its own maxspeed alone: "
                "lower that setting instead of the speed asked for"
            )
        return f"{command} {velocity}"

    def warnings(self) -> list[str]:
        """Ask for all flags that are set.

        Raises
        ------
        ProtocolError
            If the answer is no list of flags.
        """
        number, *flags = self._line.order(self.target, "warnings").data.split(" ")
        if number != f"{len(flags):02d}" or not all(len(flag) == 2 and flag.isupper() for flag in flags):
            raise ProtocolError(
                f"{self.name} answered a question for its warnings with {number!r} and {len(flags)} flags"
            )
        return flags

    def report(self, reply: Reply) -> AxisReport | None:
        """Return what an answer to ``get pos`` tells, None if it is rejected or holds no position."""
        found = integers(reply.data, 1) if reply.accepted else None
        if found is None:
            return None
        flag = reply.warning
        stops = flag.startswith("F") or flag in DOUBTFUL
        return AxisReport(
            position=self.angle(found[0]),
            busy=reply.busy,
            homed=flag not in NOT_HOMED if not flag.startswith(("F", "W")) or flag in NOT_HOMED else None,
            fault=describe(flag) if stops else "",
        )


def describe(flag: str) -> str:
    """Return a warning flag in words.

    >>> describe("FS"), describe("FX")
    ('stalled and stopped (FS)', 'an unknown fault (FX)')
    """
    return f"{WARNINGS.get(flag, 'an unknown fault' if flag.startswith('F') else 'an unknown warning')} ({flag})"
