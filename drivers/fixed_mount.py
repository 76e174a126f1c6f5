"""What a gyro stands on where there is no stage: a mount that never moves, or one that the operator turns by hand.

Both satisfy `drivers.api.Stage`, so that a measurement without a stage is one like any other. They have no driver name
and no address: whoever puts a bench together makes them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from drivers.api import Clock, DeviceIdentity, SelfTest, StageLimits, StageMode, StageState

#: rad/s; what a plan reckons with for a turn by hand: half a turn in a quarter of a minute.
HAND_SPEED = math.pi / 15.0
_SAME = 1e-6  # rad


class Operator(Protocol):
    """Somebody who can be asked to do something and says when it is done."""

    def ask(self, request: str) -> None:
        """Put a request to the operator; never waits."""

    def has_answered(self) -> bool:
        """Return whether the operator has said that it is done. Never waits."""


class FixedMount:
    """A stage at azimuth and elevation zero for ever, or, with an operator, one that is turned about its azimuth."""

    def __init__(self, clock: Clock, operator: Operator | None = None) -> None:
        self._clock = clock
        self._operator = operator
        self._target = 0.0
        self._state = self._at(0.0)

    @property
    def limits(self) -> StageLimits:
        """No elevation, and any azimuth if there is somebody to turn it."""
        reach = 0.0 if self._operator is None else 2.0 * math.pi
        speed = math.inf if self._operator is None else HAND_SPEED
        return StageLimits(azimuth_min=-reach, azimuth_max=reach, elevation_min=0.0, elevation_max=0.0, max_speed=speed)

    @property
    def troubles(self) -> Mapping[str, int]:
        """None: there is no link."""
        return {}

    def connect(self) -> DeviceIdentity:
        """Say what it is."""
        model = "fixed mount" if self._operator is None else "turned by hand"
        return DeviceIdentity(kind="stage", model=model, serial_number="")

    def self_test(self) -> SelfTest:
        """Pass: there is nothing to test."""
        return SelfTest()

    def home(self) -> None:
        """Stay: it is where it is."""

    def move(self, azimuth: float, elevation: float, *, speed: float | None = None) -> None:  # noqa: ARG002  # a stage's
        """Ask the operator for the turn. Raises ValueError if nobody can make it."""
        turn = azimuth - self._state.azimuth
        if abs(elevation) > _SAME or (self._operator is None and abs(turn) > _SAME):
            raise ValueError(
                f"there is no stage to turn to azimuth {math.degrees(azimuth):g}, elevation {math.degrees(elevation):g}"
            )
        if self._operator is None or abs(turn) <= _SAME:
            return
        way = "clockwise" if turn > 0.0 else "counterclockwise"
        way = "either way" if abs(abs(turn) - math.pi) < _SAME else f"{way}, seen from above,"
        self._operator.ask(f"turn the gyro by {abs(math.degrees(turn)):g} deg {way} and leave it at rest")
        self._target = azimuth
        self._state = self._at(self._state.azimuth, StageMode.MOVING)

    def state(self) -> StageState:
        """Return where it stands; the same object until something has changed."""
        if self._state.mode is StageMode.MOVING and self._operator is not None and self._operator.has_answered():
            self._state = self._at(self._target)
        return self._state

    def stop(self) -> None:
        """Expect the turn no longer that was asked for."""
        if self._state.mode is StageMode.MOVING:
            self._state = self._at(self._state.azimuth)

    def clear_fault(self) -> None:
        """Do nothing: it has no faults."""

    def close(self) -> None:
        """Do nothing: there is no link."""

    def _at(self, azimuth: float, mode: StageMode = StageMode.IDLE) -> StageState:
        return StageState(
            device_time=0.0,  # it has no clock, so nothing that the operator does comes too late
            arrival_time=self._clock.now(),
            mode=mode,
            azimuth=azimuth,
            elevation=0.0,
            in_position=mode is StageMode.IDLE,
        )
