"""Where a stage may be sent: its axes' limits, narrowed by the host's, and targets held to them."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

from drivers.api import StageLimits


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """Where an axis may go and how fast, in rad and s."""

    lowest: float
    highest: float
    max_speed: float
    max_acceleration: float


def joined(azimuth: AxisLimits, elevation: AxisLimits | None) -> StageLimits:
    """Return the limits of a stage's axes as its own; without an elevation axis the elevation is 0."""
    axes = [azimuth] if elevation is None else [azimuth, elevation]
    return StageLimits(
        azimuth_min=azimuth.lowest,
        azimuth_max=azimuth.highest,
        elevation_min=0.0 if elevation is None else elevation.lowest,
        elevation_max=0.0 if elevation is None else elevation.highest,
        max_speed=min(axis.max_speed for axis in axes),
        max_acceleration=min(axis.max_acceleration for axis in axes),
    )


def narrowed(device: StageLimits, own: StageLimits | None) -> StageLimits:
    """Return what both the device and the host allow; None narrows nothing.

    Raises
    ------
    ValueError
        If that is nothing.
    """
    if own is None:
        return device
    both = StageLimits(
        azimuth_min=max(device.azimuth_min, own.azimuth_min),
        azimuth_max=min(device.azimuth_max, own.azimuth_max),
        elevation_min=max(device.elevation_min, own.elevation_min),
        elevation_max=min(device.elevation_max, own.elevation_max),
        max_speed=min(device.max_speed, own.max_speed),
        max_acceleration=device.max_acceleration,
    )
    if both.azimuth_min > both.azimuth_max or both.elevation_min > both.elevation_max or both.max_speed <= 0:
        raise ValueError("the limits asked for leave the stage nowhere to go within its own")
    return both


def require_within(name: str, value: float, least: float, most: float, *, unit: str, slack: float) -> None:
    """Raise ValueError unless an angle or speed lies between `least` and `most`, to within `slack`, all in rad.

    Parameters
    ----------
    name, unit
        For the message: ``azimuth``, and ``deg`` or ``deg/s``.
    value, least, most, slack
        In rad or rad/s.
    """
    if not least - slack <= value <= most + slack:
        raise ValueError(
            f"{name} {degrees(value):.4f} {unit} lies outside the stage's limits, "
            f"{degrees(least):.4f} to {degrees(most):.4f} {unit}"
        )
