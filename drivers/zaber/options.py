"""What must be known of the axes of a Zaber stage: where they are on the line, and how far a microstep goes."""

from __future__ import annotations

from dataclasses import dataclass

AXIS_NAMES = ("azimuth", "elevation")

#: Microsteps a degree by device id, where no peripheral can change them. 65001 is the emulated controller.
KNOWN_UNITS_PER_DEG = {65001: 3600.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisOptions:
    """One axis of the stage."""

    name: str  #: "azimuth" or "elevation"
    device: int  #: number on the line
    axis: int  #: of the device, from 1 on
    units_per_deg: float | None = None  #: microsteps, negative if the axis counts the other way; None: by device id
    position_zero_deg: float = 0.0  #: the stage's angle where the axis' position is 0

    def __post_init__(self) -> None:
        """Check what would otherwise be found out in motion."""
        if not (1 <= self.device <= 99 and 1 <= self.axis <= 9):
            raise ValueError(
                f"the {self.name} axis is axis {self.axis} of device {self.device}: "
                "a device has a number of 1 to 99, its axis one of 1 to 9"
            )
        if self.units_per_deg is not None and not 1.0 <= abs(self.units_per_deg) <= 1e9:
            raise ValueError(
                f"{self.name}_units_per_deg is {self.units_per_deg:g}: expected the microsteps of one degree, "
                "1 to 1e9, negative if the axis counts the other way"
            )
        if not abs(self.position_zero_deg) <= 3600.0:
            raise ValueError(f"{self.name}_zero_deg is {self.position_zero_deg:g}: expected -3600 to 3600")
