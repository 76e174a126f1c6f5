"""What a stage of Zaber axes is doing: by what it was told, and by what its axes report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf

from drivers.api import StageMode, StageState
from drivers.zaber.axis import AxisReport, ZaberAxis

STATE_PERIOD = 0.1  # s after which an unchanged state is told as a new one
SETTLE_TIME = 1.0  # s within which a stage at rest must be at its target
IN_MOTION = {StageMode.MOVING, StageMode.HOMING, StageMode.STOPPING}
_ELSEWHERE = "the stage has come to rest away from its target"
_HOMING_FAILED = "homing has ended without a reference position"


class Motion:
    """The state of a stage of an azimuth axis and perhaps an elevation axis; without one the elevation is 0."""

    def __init__(self, axes: Sequence[ZaberAxis]) -> None:
        self.state: StageState | None = None  #: newest
        self.homed = [False] * len(axes)  #: which axes have their reference
        self._axes = axes
        self._targets: tuple[float, ...] = ()  # of the last move accepted, rad
        self._begun = StageMode.MOVING  # what a busy axis is taken to do
        self._failure = ""  # a fault that has been found here, not by the devices
        self._told_at = 0.0
        self._arrived_at = -inf  # when the stage was first at rest after the last move
        self._suspect = False  # whether a stage at rest was found elsewhere, once

    # What it is told

    def forget(self) -> None:
        """Know nothing of targets and failures any more."""
        self._targets, self._failure = (), ""

    def come_to_rest(self) -> None:
        """Take what still moves for stopping."""
        self._begun = StageMode.STOPPING
        self._targets = ()
        if self.state is not None and self.state.mode in IN_MOTION:
            self.state = replace(self.state, mode=StageMode.STOPPING)

    def set_out(self, mode: StageMode) -> None:
        """Note that the axes are being told to home, or to move."""
        self.forget()
        self._begun = mode
        if mode is StageMode.HOMING:
            self.homed = [False] * len(self._axes)

    def accepted(self, targets: tuple[float, ...], now: float) -> None:
        """Note that all axes have accepted, with the angles in rad where they go, none while homing."""
        self._targets, self._arrived_at = targets, now
        if self.state is not None:
            self.state = replace(self.state, mode=self._begun, in_position=False)

    # What its axes report

    def note(self, reports: list[AxisReport], now: float) -> bool:
        """Make a state of what all axes have told; return whether the stage must be stopped for a fault."""
        for index, report in enumerate(reports):
            if report.homed is not None:
                self.homed[index] = report.homed
        busy = any(report.busy for report in reports)
        angles = [report.position for report in reports]
        if self._moved_at_rest(angles, busy=busy):
            return False
        named = zip(self._axes, reports, strict=True)
        faults = ", ".join(f"{axis.options.name} {report.fault}" for axis, report in named if report.fault)
        if not faults:
            self._judge(angles, now, busy=busy)
        fault = faults or self._failure
        must_stop = bool(fault) and busy and self._begun is not StageMode.STOPPING
        state = StageState(
            device_time=now,
            arrival_time=now,
            mode=self._mode(fault, busy=busy),
            azimuth=angles[0],
            elevation=angles[1] if len(angles) > 1 else 0.0,
            in_position=not fault and not busy and self._reached(angles),
            fault=fault,
        )
        if not (_same(state, self.state) and now - self._told_at < STATE_PERIOD):
            self.state, self._told_at = state, now
        if must_stop:
            self._begun = StageMode.STOPPING
        elif not busy:
            self._begun = StageMode.MOVING
        return must_stop

    def _judge(self, angles: list[float], now: float, *, busy: bool) -> None:
        """Find out whether a motion has ended as it should, where the devices see no fault."""
        if busy:
            self._arrived_at = now
        elif self._begun is StageMode.HOMING and not all(self.homed):
            self._failure = _HOMING_FAILED
        elif self._targets and not self._reached(angles) and now - self._arrived_at > SETTLE_TIME:
            self._failure = _ELSEWHERE

    def _mode(self, fault: str, *, busy: bool) -> StageMode:
        if fault:
            return StageMode.FAULT
        if busy:
            return self._begun
        return StageMode.IDLE if all(self.homed) else StageMode.NOT_HOMED

    def _moved_at_rest(self, angles: list[float], *, busy: bool) -> bool:
        """Return whether a stage at rest seems to have moved, for the first time: the next answer must confirm it.

        Damage that the weak checksum has let through would otherwise count as a position.
        """
        before = self.state
        if busy or before is None or before.mode is not StageMode.IDLE:
            self._suspect = False
            return False
        places = zip(self._axes, angles, (before.azimuth, before.elevation), strict=False)
        self._suspect = not self._suspect and any(abs(angle - old) > axis.tolerance for axis, angle, old in places)
        return self._suspect

    def _reached(self, angles: list[float]) -> bool:
        if not self._targets:
            return False
        places = zip(self._axes, angles, self._targets, strict=True)
        return all(abs(angle - target) <= axis.tolerance for axis, angle, target in places)


def _same(state: StageState, other: StageState | None) -> bool:
    """Return whether two states differ in their time alone."""
    return other is not None and state == replace(other, device_time=state.device_time, arrival_time=state.arrival_time)
