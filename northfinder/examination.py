"""Examining a bench: open its devices, let them test themselves, listen to them; moved only when told so."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from drivers.api import Clock, DeviceIdentity, Gyro, RateBlock, SelfTest, Stage, StageLimits, StageMode, StageState
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError
from northfinder.doctor import AT_REST, Finding, Stream, skipped, verdict
from northfinder.sequencer import StopRequestedError

Device = TypeVar("Device", Gyro, Stage)

#: How often the devices are served, in s.
_SERVICE = 0.05
#: How far a stage is moved and back, rad, where it may be moved.
SMALL_MOVE = math.radians(5.0)
#: s, within which homing or a small move must end.
_HOME_TIMEOUT, _MOVE_TIMEOUT = 180.0, 30.0
#: Host time for a stream beyond its duration, as a factor and in s.
_PATIENCE, _GRACE = 1.2, 5.0


@dataclass(slots=True, kw_only=True)
class Examination:
    """Speaks to the devices and keeps what they said; what goes wrong on the way becomes a finding."""

    open_gyro: Callable[[], Gyro]
    open_stage: Callable[[], Stage] | None
    clock: Clock
    stop_requested: Callable[[], bool] = lambda: False
    findings: list[Finding] = field(default_factory=list)
    stream: Stream | None = None  #: None if the gyro could not be heard
    states: list[StageState] = field(default_factory=list)  #: while the stage was left alone
    limits: StageLimits | None = None  #: None if the stage could not be spoken to
    _gyro: Gyro | None = None
    _stage: Stage | None = None

    def run(self, *, duration: float, move: bool = False) -> None:
        """Examine the bench for `duration` s of the gyro's samples; move the stage a little only if `move`.

        The devices are left at rest and their links released, whatever happens.
        """
        try:
            self._gyro = self._opened("gyro", self.open_gyro)
            self._stage = None if self.open_stage is None else self._opened("stage", self.open_stage)
            if self._stage is not None:
                self.limits = self._stage.limits
            if self._gyro is not None:
                self._listen(self._gyro, duration)
            if self._stage is not None and move:
                self._move(self._stage)
            elif self._stage is not None:
                self.findings.append(skipped("move", "nothing was moved: --move allows small moves"))
        finally:
            for device in (self._stage, self._gyro):
                if device is not None:
                    device.close()

    def _opened(self, name: str, opener: Callable[[], Device]) -> Device | None:
        """Open a device, ask who it is and let it test itself; None, with a finding, if it cannot be used."""
        device: Device | None = None
        try:
            device = opener()
            self._test(name, device.connect(), device.self_test())
        except DeviceError as error:
            self.findings.append(verdict(name, str(error), passed=False))
            if device is not None:
                device.close()
            return None
        return device

    def _test(self, name: str, identity: DeviceIdentity, test: SelfTest) -> None:
        number = f", serial number {identity.serial_number}" if identity.serial_number else ""
        self.findings.append(verdict(name, f"{identity.model} answers{number}", passed=True))
        outcome = f"failed its self-test: {', '.join(test.failures)}" if test.failures else "passed its self-test"
        self.findings.append(verdict(f"{name} self-test", f"the {name} {outcome}", passed=test.passed))

    def _listen(self, gyro: Gyro, duration: float) -> None:
        """Take in what the gyro sends at rest."""
        blocks: list[RateBlock] = []
        try:
            gyro.start()
            wanted, deadline = duration * gyro.sample_rate, self.clock.now() + _PATIENCE * duration + _GRACE
            while not blocks or blocks[-1].first_index + len(blocks[-1].counts) < wanted:
                blocks += self._served(gyro, deadline)
            gyro.stop()
        except DeviceError as error:
            self.findings.append(verdict("stream", str(error), passed=False))
        self.stream = Stream(sample_rate=gyro.sample_rate, n_axes=gyro.n_axes, blocks=tuple(blocks))

    def _served(self, gyro: Gyro, deadline: float) -> list[RateBlock]:
        """Return what has come, after a wait if that is nothing; keep the stage company."""
        if self.stop_requested():
            raise StopRequestedError("stopped on request: nothing was moved")
        before = self.states[-1] if self.states else None
        if self._stage is not None and (state := self._stage.state()) is not before:
            self.states.append(state)
        blocks = gyro.read()
        if not blocks:
            if self.clock.now() >= deadline:
                raise DeviceTimeoutError("samples come far slower than the gyro says: is its sample rate set right?")
            self.clock.wait(min(deadline, self.clock.now() + _SERVICE))
        return blocks

    def _move(self, stage: Stage) -> None:
        """Home the stage if need be, and move each axis a little, there and back."""
        try:
            if stage.state().mode is not StageMode.IDLE:
                stage.home()
                self._wait(stage, _HOME_TIMEOUT, "homing")
            start = stage.state()
            there = (self._beside("azimuth", start.azimuth), self._beside("elevation", start.elevation))
            for azimuth, elevation in (there, (start.azimuth, start.elevation)):
                stage.move(azimuth, elevation)
                state = self._wait(stage, _MOVE_TIMEOUT, "the move", in_position=True)
                off = max(abs(state.azimuth - azimuth), abs(state.elevation - elevation))
                if off > AT_REST:
                    says = f"the stage says that it has arrived, and stands off by {math.degrees(off):.3g} deg"
                    self.findings.append(verdict("move", says, passed=False))
                    return
        except (DeviceError, ValueError) as error:
            self.findings.append(verdict("move", str(error), passed=False))
            return
        says = f"both axes went {math.degrees(SMALL_MOVE):g} deg aside and came back to their places"
        self.findings.append(verdict("move", says, passed=True))

    def _beside(self, axis: str, angle: float) -> float:
        """Return an angle a little aside, within the limits."""
        highest = math.inf if self.limits is None else getattr(self.limits, f"{axis}_max")
        return angle + (SMALL_MOVE if angle + SMALL_MOVE <= highest else -SMALL_MOVE)

    def _wait(self, stage: Stage, timeout: float, doing: str, *, in_position: bool = False) -> StageState:
        deadline = self.clock.now() + timeout
        while True:
            state = stage.state()
            if state.mode is StageMode.FAULT:
                raise DeviceFaultError(f"{doing} ended in {state.fault}; the stage stays stopped until it is cleared")
            if state.mode is StageMode.IDLE and (state.in_position or not in_position):
                return state
            if self.clock.now() >= deadline:
                stage.stop()
                raise DeviceTimeoutError(f"{doing} has not ended within {timeout:g} s: the stage is {state.mode.value}")
            if self.stop_requested():
                stage.stop()
                raise StopRequestedError("stopped on request: the stage comes to rest")
            self.clock.wait(min(deadline, self.clock.now() + _SERVICE))
