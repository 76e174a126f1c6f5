"""How the stage's drives are used: what a drive of the market needs to be told."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOptions:
    """Units, homing and motion of both drives; None leaves to a drive what it has.

    Pairs are azimuth and elevation. `units_per_turn` counts position units of the drive a turn of the stage, negative
    if the drive counts the other way; left out it is the drive's encoder resolution (608F), without any gear.
    """

    units_per_turn: tuple[float | None, float | None] = (None, None)
    speed_units: float | None = None  #: speed units of the drive per turn/s, the position units if None
    acceleration_units: float | None = None  #: likewise, per turn/s^2
    acceleration: float | None = None  #: rad/s^2, of moves
    homing_method: int | None = None  #: of object 6098
    home_speed: float | None = None  #: rad/s, search for the switch
    home_creep: float | None = None  #: rad/s, search for its edge
    home_offset: tuple[float, float] = (0.0, 0.0)  #: rad, position at the reference
    quick_stop: int = 6  #: option code of object 605A: at the quick stop ramp, and stay there

    def __post_init__(self) -> None:
        """Check what would otherwise be found out in motion."""
        for name in ("speed_units", "acceleration_units", "acceleration", "home_speed", "home_creep"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"the drive's {name} must be positive, got {value:g}")
        if 0 in self.units_per_turn:
            raise ValueError("the drive's units_per_turn must not be 0")
        if self.quick_stop not in {1, 2, 5, 6}:
            raise ValueError(f"the drive's quick_stop must be 1, 2, 5 or 6, got {self.quick_stop}")
