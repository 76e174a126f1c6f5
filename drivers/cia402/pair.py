"""Two axes, azimuth and elevation, as one stage: who it is, and what it does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from drivers.api import DeviceIdentity, StageMode, StageState
from drivers.cia402.axis import AXIS_NAMES, Activity, Axis

_MODES = {
    Activity.OFFERED: StageMode.MOVING,
    Activity.TAKEN: StageMode.MOVING,
    Activity.MOVING: StageMode.MOVING,
    Activity.HOMING_ASKED: StageMode.HOMING,
    Activity.HOMING: StageMode.HOMING,
    Activity.STOPPING: StageMode.STOPPING,
}
_ORDER = (StageMode.STOPPING, StageMode.HOMING, StageMode.MOVING)  # what the stage does if its axes differ


def identity_of(first: DeviceIdentity, second: DeviceIdentity) -> DeviceIdentity:
    """Return two drives as one device."""
    return replace(first, serial_number=", ".join(dict.fromkeys((first.serial_number, second.serial_number))))


def state_of(axes: Sequence[Axis], now: float) -> StageState:
    """Return the state by what the axes have told up to `now`, the host's time in s."""
    azimuth, elevation = axes
    told_ms = [axis.device_time_ms for axis in axes if axis.device_time_ms is not None]
    return StageState(
        device_time=max(told_ms) / 1000 if told_ms else now,
        arrival_time=now,
        mode=_mode(axes),
        azimuth=azimuth.position / azimuth.units,
        elevation=elevation.position / elevation.units,
        azimuth_rate=azimuth.velocity / azimuth.speed_units,
        elevation_rate=elevation.velocity / elevation.speed_units,
        in_position=azimuth.in_position and elevation.in_position,
        fault=_fault(azimuth.fault, elevation.fault),
    )


def _mode(axes: Sequence[Axis]) -> StageMode:
    if any(axis.fault for axis in axes):
        return StageMode.FAULT
    modes = {_MODES.get(axis.activity) for axis in axes}
    for mode in _ORDER:
        if mode in modes:
            return mode
    return StageMode.IDLE if all(axis.homed for axis in axes) else StageMode.NOT_HOMED


def _fault(*faults: str) -> str:
    """Return the faults of both axes by name."""
    if faults[0] == faults[1]:
        return faults[0]
    return ", ".join(f"{fault} ({name})" for name, fault in zip(AXIS_NAMES, faults, strict=True) if fault)
