"""One or two axes of Zaber devices as a rotation stage. See ``docs/zaber.md``.

A Zaber device has no watchdog: a motion that was begun goes on to its end whether or not the host is still there. So
only moves to a place within the limits are ever begun, and the driver sends stop whenever it is closed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from drivers.api import ByteLink, Clock, DeviceIdentity, SelfTest, StageLimits, StageMode, StageState
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError
from drivers.limits import joined, narrowed, require_within
from drivers.protocol.zaber import NOT_HOMED, LineCounts
from drivers.zaber.axis import ZaberAxis, describe
from drivers.zaber.identity import meet
from drivers.zaber.line import Line
from drivers.zaber.motion import IN_MOTION, Motion
from drivers.zaber.options import AxisOptions
from drivers.zaber.poll import POLL_PERIOD, Poll

REST_TIMEOUT = 10.0  # s for a stage found moving to come to rest
STOP_INTERVAL = 0.05  # s between repetitions of a stop
STOP_ATTEMPTS = 20


class ZaberStage:
    """A stage of one or two Zaber axes; a `drivers.api.Stage`.

    Parameters
    ----------
    link
        The open line to the devices; the driver closes it.
    clock
        The clock that `link` notifies.
    axes
        The azimuth axis, and the elevation axis if there is one; else the elevation is 0.
    limits
        Narrows the limits that the devices have; never widens them.
    """

    def __init__(
        self, link: ByteLink, clock: Clock, axes: Sequence[AxisOptions], *, limits: StageLimits | None = None
    ) -> None:
        self._clock = clock
        self._line = Line(link, clock)
        self._axes = [ZaberAxis(self._line, options) for options in axes]
        self._own_limits = limits
        self._limits: StageLimits | None = None
        self._poll = Poll(self._line, clock, self._axes)
        self._motion = Motion(self._axes)

    @property
    def name(self) -> str:
        """For messages."""
        return f"the stage on {self._line.name}"

    @property
    def limits(self) -> StageLimits:
        """Where the stage may be sent, known after `connect`."""
        if self._limits is None:
            raise LinkError(f"{self.name} has not told its limits yet: connect first")
        return self._limits

    @property
    def line_counts(self) -> LineCounts:
        """What has come over the line."""
        return self._line.counts

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong on the link and been made up for."""
        return self._line.troubles

    def connect(self) -> DeviceIdentity:
        """Meet the devices, read limits and flags. Never moves; brings a moving stage to rest.

        Switches on the checksums of the devices' answers, which is a setting that they keep.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If it is no such device.
        ValueError
            If the microsteps of a degree are not known, or the limits asked for leave nowhere to go.
        """
        self._motion.state = self._limits = None
        self._motion.forget()
        self._poll.drop()
        devices = {
            number: meet(self._line, number) for number in dict.fromkeys(axis.target.device for axis in self._axes)
        }
        self._line.require_sums()
        found = [axis.meet(devices[axis.target.device]) for axis in self._axes]
        self._limits = narrowed(joined(found[0], found[1] if len(found) > 1 else None), self._own_limits)
        self._order_all("stop")
        self._read_flags()
        self._await_rest()
        first, *_ = identities = [device.identity for device in devices.values()]
        return replace(first, serial_number=", ".join(identity.serial_number for identity in identities))

    def _read_flags(self) -> None:
        """Learn which axes have their reference: a graver flag may hide that in the answers to polls."""
        self._motion.homed = [NOT_HOMED.isdisjoint(axis.warnings()) for axis in self._axes]

    def _await_rest(self) -> None:
        """Wait for the first state, and for a stage found in motion to come to rest."""
        self._motion.come_to_rest()
        self._poll.restart()
        deadline = self._clock.now() + REST_TIMEOUT
        while self._serve() is None or self.state().mode in IN_MOTION:
            if self._clock.now() >= deadline:
                raise DeviceTimeoutError(f"{self.name} has not come to rest within {REST_TIMEOUT:g} s of a stop")
            self._clock.wait(min(deadline, self._clock.now() + POLL_PERIOD))

    def self_test(self) -> SelfTest:
        """Report the flags that are set, as far as homing will not clear them: the devices test themselves all along.

        Never moves.
        """
        self._require_connected()
        failures = [
            f"{axis.options.name}: {describe(flag)}"
            for axis in self._axes
            for flag in axis.warnings()
            if flag not in NOT_HOMED and not flag.startswith("N")
        ]
        return SelfTest(tuple(failures))

    def home(self) -> None:
        """Begin homing of all axes; `state` tells when it is done.

        Raises
        ------
        DeviceFaultError
            If a device refuses, or the stage is not at rest.
        """
        self._require_rest("homing")
        self._set_out(["home"] * len(self._axes), StageMode.HOMING)

    def move(self, azimuth: float, elevation: float, *, speed: float | None = None) -> None:
        """Begin a move of all axes to absolute angles in rad; `speed` in rad/s, the limit if None.

        Raises
        ------
        ValueError
            If the target or the speed lies outside `limits`.
        DeviceFaultError
            If a device refuses, or the stage is not homed or not at rest.
        """
        limits = self.limits
        speed = limits.max_speed if speed is None else speed
        azimuth_axis, *others = self._axes
        slack = [azimuth_axis.half_unit, others[0].half_unit if others else 1e-9]
        require_within("azimuth", azimuth, limits.azimuth_min, limits.azimuth_max, unit="deg", slack=slack[0])
        require_within("elevation", elevation, limits.elevation_min, limits.elevation_max, unit="deg", slack=slack[1])
        require_within("speed", speed, 2 * slack[0], limits.max_speed, unit="deg/s", slack=0.0)
        self._require_rest("a move")
        if not all(self._motion.homed):
            raise DeviceFaultError(f"{self.name} must be homed first")
        targets = (azimuth, elevation)[: len(self._axes)]
        commands = [axis.move_command(angle, speed) for axis, angle in zip(self._axes, targets, strict=True)]
        self._set_out(commands, StageMode.MOVING, targets)

    def state(self) -> StageState:
        """Service the line and return the newest state. Never waits.

        Raises
        ------
        LinkError
            If the link is lost.
        DeviceTimeoutError
            If an axis has not answered for a second.
        """
        self._require_connected()
        state = self._serve()
        if state is None:
            raise LinkError(f"{self.name} has told no state yet: connect first")
        return state

    def stop(self) -> None:
        """Bring all axes to rest in a controlled way; returns while they still slow down.

        Raises
        ------
        DeviceTimeoutError
            If an axis does not accept within a second: it then goes on to the end of its move.
        """
        self._require_connected()
        try:
            self._order_all("stop")
        except DeviceTimeoutError as error:
            raise DeviceTimeoutError(f"{error}; press the emergency stop if it moves") from error
        self._motion.come_to_rest()

    def clear_fault(self) -> None:
        """Forget flags and switch the drivers on, on the operator's word alone. Never moves.

        Raises
        ------
        DeviceFaultError
            If an axis still moves, or a driver cannot be switched on.
        """
        if self.state().mode in IN_MOTION:
            raise DeviceFaultError(f"{self.name} still moves: a fault can be cleared at rest alone")
        for axis in self._axes:
            flags = axis.warnings()
            self._line.order(axis.target, "warnings clear")
            if any(flag.startswith("F") for flag in flags):
                self._line.order(axis.target, "driver enable")
        self._motion.forget()
        self._read_flags()
        self._await_rest()

    def close(self) -> None:
        """Send stop if the line still lives, and release it."""
        try:
            if self._limits is not None:
                self._order_all("stop", attempts=6)
        except DeviceError:
            pass  # the line is on its way out; a move under way ends at its target
        finally:
            self._limits = self._motion.state = None
            self._line.close()

    # Commands to all axes

    def _set_out(self, commands: list[str], mode: StageMode, targets: tuple[float, ...] = ()) -> None:
        """Give each axis its command; if one of them is refused or unanswered, stop all."""
        self._motion.set_out(mode)
        try:
            for axis, command in zip(self._axes, commands, strict=True):
                self._line.order(axis.target, command)
        except DeviceError:
            self._order_all("stop")
            raise
        finally:
            self._poll.drop()
        self._motion.accepted(targets, self._clock.now())

    def _order_all(self, command: str, attempts: int = STOP_ATTEMPTS) -> None:
        """Order a stop: to all at once first, so that none waits for another's answer."""
        numbers = [self._line.send(axis.target, command) for axis in self._axes]
        self._poll.drop()
        for axis in self._axes:
            self._line.ask(axis.target, command, interval=STOP_INTERVAL, attempts=attempts)
        for number in numbers:
            self._line.forget(number)

    def _require_connected(self) -> None:
        if self._limits is None:
            raise LinkError(f"{self.name} is not connected: connect first")

    def _require_rest(self, what: str) -> None:
        state = self.state()
        if state.mode is StageMode.FAULT:
            raise DeviceFaultError(f"{self.name} refuses {what}: {state.fault} must be cleared first")
        if state.mode in IN_MOTION:
            raise DeviceFaultError(f"{self.name} refuses {what}: it must be at rest first")

    # Polling

    def _serve(self) -> StageState | None:
        """Take in answers, ask again if it is time, and return the newest state, None before the first."""
        reports, now = self._poll.take(), self._clock.now()
        if reports and self._motion.note(reports, now):
            for axis in self._axes:  # the answers do not matter: the next polls tell
                self._line.forget(self._line.send(axis.target, "stop"))
        self._poll.ask(now)
        return self._motion.state
