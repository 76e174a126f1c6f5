"""One or two axes of Zaber devices as a rotation stage. See ``docs/zaber.md``.

A Zaber device has no watchdog: a motion that was begun goes on to its end whether or not the host is still there. So
only moves to a place within the limits are ever begun, and the driver sends stop whenever it is closed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from math import inf

from drivers.api import ByteLink, Clock, DeviceIdentity, SelfTest, StageLimits, StageMode, StageState
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.limits import joined, narrowed, require_within
from drivers.protocol.zaber import NOT_HOMED, LineCounts, integers
from drivers.zaber.axis import AxisReport, ZaberAxis, describe
from drivers.zaber.line import Line, Target
from drivers.zaber.options import AxisOptions

POLL_PERIOD = 0.01  # s between questions for the position, unless an alert calls for one
STATE_PERIOD = 0.1  # s after which an unchanged state is told as a new one
ANSWER_TIMEOUT = 0.25  # s after which a question for the position is asked again
MAX_SILENCE = 1.0  # s without an answer
SETTLE_TIME = 1.0  # s within which a stage at rest must be at its target
REST_TIMEOUT = 10.0  # s for a stage found moving to come to rest
STOP_INTERVAL = 0.05  # s between repetitions of a stop
STOP_ATTEMPTS = 20
_MOTIONS = {StageMode.MOVING, StageMode.HOMING, StageMode.STOPPING}
_ELSEWHERE = "the stage has come to rest away from its target"
_HOMING_FAILED = "homing has ended without a reference position"


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
        self._state: StageState | None = None
        self._targets: tuple[float, ...] | None = None  # of the last move accepted, rad
        self._homed = [False] * len(self._axes)
        self._begun = StageMode.MOVING  # what a busy axis is taken to do
        self._failure = ""  # a fault that the driver has found, not the device
        self._poll: dict[int, int] = {}  # axis to number of the question that is open
        self._reports: list[AxisReport | None] = [None] * len(self._axes)
        self._polled_at = self._told_at = 0.0
        self._waiting_since: float | None = None  # when the first poll was sent that has no answer yet
        self._odd_answer = ""  # to a poll, since the last good one
        self._arrived_at = -inf  # when the stage was first at rest after the last move
        self._suspect = False  # whether a stage at rest was found elsewhere, once

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
        self._state = self._limits = self._targets = None
        self._failure = ""
        self._drop_poll()
        identities = {device: self._meet(device) for device in dict.fromkeys(axis.target.device for axis in self._axes)}
        self._line.require_sums()
        found = []
        for axis in self._axes:
            identity = identities[axis.target.device]
            found.append(axis.meet(_device_id(identity), _firmware(identity.firmware_version)))
        self._limits = narrowed(joined(found[0], found[1] if len(found) > 1 else None), self._own_limits)
        self._order_all("stop")
        self._read_flags()
        self._await_rest()
        first = next(iter(identities.values()))
        numbers = ", ".join(identity.serial_number for identity in identities.values())
        return replace(first, serial_number=numbers)

    def _meet(self, device: int) -> DeviceIdentity:
        """Ask a device who it is, and switch its checksums on."""
        target = Target(device)
        answers = {}
        for setting in ("deviceid", "version", "system.serial"):
            reply = self._line.ask(target, f"get {setting}")
            if not reply.accepted:
                raise self._line.refusal(target, f"get {setting}", reply)
            answers[setting] = reply.data
        self._line.ask(target, "set comm.checksum 1")
        return DeviceIdentity(
            kind="stage",
            model=f"Zaber {answers['deviceid']}",
            serial_number=answers["system.serial"],
            firmware_version=answers["version"],
            protocol="Zaber ASCII 2",
        )

    def _read_flags(self) -> None:
        """Learn which axes have their reference: a graver flag may hide that in the answers to polls."""
        self._homed = [NOT_HOMED.isdisjoint(axis.warnings()) for axis in self._axes]

    def _await_rest(self) -> None:
        """Wait for the first state, and for a stage found in motion to come to rest."""
        self._begun = StageMode.STOPPING
        self._waiting_since = None
        deadline = self._clock.now() + REST_TIMEOUT
        while self._serve() is None or self.state().mode in _MOTIONS:
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
        self._targets = None
        self._homed = [False] * len(self._axes)
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
        if not all(self._homed):
            raise DeviceFaultError(f"{self.name} must be homed first")
        targets = (azimuth, elevation)[: len(self._axes)]
        commands = [axis.move_command(angle, speed) for axis, angle in zip(self._axes, targets, strict=True)]
        self._targets = None
        self._set_out(commands, StageMode.MOVING)
        self._targets, self._arrived_at = targets, self._clock.now()

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
        self._begun = StageMode.STOPPING
        self._targets = None
        if self._state is not None and self._state.mode in _MOTIONS:
            self._state = replace(self._state, mode=StageMode.STOPPING)

    def clear_fault(self) -> None:
        """Forget flags and switch the drivers on, on the operator's word alone. Never moves.

        Raises
        ------
        DeviceFaultError
            If an axis still moves, or a driver cannot be switched on.
        """
        if self.state().mode in _MOTIONS:
            raise DeviceFaultError(f"{self.name} still moves: a fault can be cleared at rest alone")
        for axis in self._axes:
            flags = axis.warnings()
            self._line.order(axis.target, "warnings clear")
            if any(flag.startswith("F") for flag in flags):
                self._line.order(axis.target, "driver enable")
        self._failure = ""
        self._targets = None
        self._drop_poll()
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
            self._limits = self._state = None
            self._line.close()

    # Commands to all axes

    def _set_out(self, commands: list[str], mode: StageMode) -> None:
        """Give each axis its command; if one of them is refused or unanswered, stop all."""
        self._failure = ""
        self._begun = mode
        try:
            for axis, command in zip(self._axes, commands, strict=True):
                self._line.order(axis.target, command)
        except DeviceError:
            self._order_all("stop")
            raise
        finally:
            self._drop_poll()
        if self._state is not None:
            self._state = replace(self._state, mode=mode, in_position=False)

    def _order_all(self, command: str, attempts: int = STOP_ATTEMPTS) -> None:
        """Order a stop: to all at once first, so that none waits for another's answer."""
        numbers = [self._line.send(axis.target, command) for axis in self._axes]
        self._drop_poll()
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
        if state.mode in _MOTIONS:
            raise DeviceFaultError(f"{self.name} refuses {what}: it must be at rest first")

    # Polling

    def _serve(self) -> StageState | None:
        """Take in answers, ask again if it is time, and return the newest state, None before the first."""
        self._line.service()
        for index, number in list(self._poll.items()):
            reply = self._line.take(number)
            if reply is None:
                continue
            del self._poll[index]
            self._reports[index] = self._axes[index].report(reply)
            if self._reports[index] is None:  # once, it may be damage; the silence counts on
                self._odd_answer = reply.data
        now = self._clock.now()
        reports = [report for report in self._reports if report is not None]
        if len(reports) == len(self._axes) and not self._poll:
            self._waiting_since, self._odd_answer = None, ""
            self._reports = [None] * len(self._axes)
            self._note(reports, now)
        self._ask(now)
        return self._state

    def _ask(self, now: float) -> None:
        """Poll the axes, unless they were polled a moment ago and have still to answer."""
        silence = 0.0 if self._waiting_since is None else now - self._waiting_since
        if silence > MAX_SILENCE:
            if self._odd_answer:
                raise ProtocolError(f"{self.name} answers questions for its position with {self._odd_answer!r}")
            raise DeviceTimeoutError(f"{self.name} has not told its position for {silence:.1f} s: was it cut off?")
        wait = ANSWER_TIMEOUT if self._poll else 0.0 if self._line.alerted else POLL_PERIOD
        due = self._polled_at + wait
        if now < due:
            self._clock.alarm(due)
            return
        self._drop_poll()
        self._line.alerted = False
        self._poll = {index: self._line.send(axis.target, "get pos") for index, axis in enumerate(self._axes)}
        self._polled_at = now
        if self._waiting_since is None:
            self._waiting_since = now

    def _drop_poll(self) -> None:
        """Forget what was asked before something changed."""
        for number in self._poll.values():
            self._line.forget(number)
        self._poll.clear()
        self._reports = [None] * len(self._axes)
        self._polled_at = -inf

    def _note(self, reports: list[AxisReport], now: float) -> None:
        """Make a state of what all axes have told."""
        for index, report in enumerate(reports):
            if report.homed is not None:
                self._homed[index] = report.homed
        busy = any(report.busy for report in reports)
        faults = [
            f"{axis.options.name} {report.fault}"
            for axis, report in zip(self._axes, reports, strict=True)
            if report.fault
        ]
        angles = [report.position for report in reports]
        if self._moved_at_rest(angles, busy=busy):
            return
        if not faults:
            self._judge(angles, now, busy=busy)
        fault = ", ".join(faults) or self._failure
        if fault and busy and self._begun is not StageMode.STOPPING:
            for axis in self._axes:  # the answers do not matter: the next polls tell
                self._line.forget(self._line.send(axis.target, "stop"))
            self._begun = StageMode.STOPPING
        state = StageState(
            device_time=now,
            arrival_time=now,
            mode=self._mode(fault, busy=busy),
            azimuth=angles[0],
            elevation=angles[1] if len(angles) > 1 else 0.0,
            in_position=not fault and not busy and self._reached(angles),
            fault=fault,
        )
        if not (_same(state, self._state) and now - self._told_at < STATE_PERIOD):
            self._state, self._told_at = state, now
        if not busy:
            self._begun = StageMode.MOVING

    def _judge(self, angles: list[float], now: float, *, busy: bool) -> None:
        """Find out whether a motion has ended as it should, where the devices see no fault."""
        if busy:
            self._arrived_at = now
        elif self._begun is StageMode.HOMING and not all(self._homed):
            self._failure = _HOMING_FAILED
        elif self._targets and not self._reached(angles) and now - self._arrived_at > SETTLE_TIME:
            self._failure = _ELSEWHERE

    def _mode(self, fault: str, *, busy: bool) -> StageMode:
        if fault:
            return StageMode.FAULT
        if busy:
            return self._begun
        return StageMode.IDLE if all(self._homed) else StageMode.NOT_HOMED

    def _moved_at_rest(self, angles: list[float], *, busy: bool) -> bool:
        """Return whether a stage at rest seems to have moved, for the first time: the next answer must confirm it.

        Damage that the weak checksum has let through would otherwise count as a position.
        """
        before = self._state
        if busy or before is None or before.mode is not StageMode.IDLE:
            self._suspect = False
            return False
        places = zip(self._axes, angles, (before.azimuth, before.elevation), strict=False)
        self._suspect = not self._suspect and any(abs(angle - old) > axis.tolerance for axis, angle, old in places)
        return self._suspect

    def _reached(self, angles: list[float]) -> bool:
        if self._targets is None:
            return False
        places = zip(self._axes, angles, self._targets, strict=True)
        return all(abs(angle - target) <= axis.tolerance for axis, angle, target in places)


def _same(state: StageState, other: StageState | None) -> bool:
    """Return whether two states differ in their time alone."""
    return other is not None and state == replace(other, device_time=state.device_time, arrival_time=state.arrival_time)


def _device_id(identity: DeviceIdentity) -> int:
    found = integers(identity.model.removeprefix("Zaber "), 1)
    if found is None:
        raise ProtocolError(f"a device's id is {identity.model.removeprefix('Zaber ')!r}, expected a number")
    return found[0]


def _firmware(version: str) -> tuple[int, int]:
    """Return a firmware's version as two numbers.

    >>> _firmware("7.35"), _firmware("6.06")
    ((7, 35), (6, 6))
    """
    found = re.match(r"(\d+)\.(\d+)", version, re.ASCII)
    if found is None:
        raise ProtocolError(f"a device's firmware is {version!r}, expected a version such as 7.35")
    return int(found[1]), int(found[2])
