"""How long a stage takes from one position to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.api import StageLimits

#: From rest to the first sample used beside the settling time, s: the status, blocks begun before and after.
BLOCK_PAUSE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Turns:
    """Time from the last sample of a dwell to the first of the next; both axes turn at once."""

    speed: float = math.inf  #: rad/s
    acceleration: float = math.inf  #: rad/s^2
    constant: float = 0.0  #: s, of every turn whatever its length
    pause: float = 0.0  #: s, before every dwell, also where nothing has to turn

    @classmethod
    def of_stage(cls, limits: StageLimits, settle: float) -> Turns:
        """Return the turns of a stage with these limits, with `settle` s at rest before samples are used."""
        return cls(speed=limits.max_speed, acceleration=limits.max_acceleration or math.inf, pause=settle + BLOCK_PAUSE)

    def duration(self, travel: float) -> float:
        """Return the time in s for a turn by `travel`, rad: ``d/v + v/a`` with ``v^2 <= a d``.

        >>> round(Turns(speed=11.25, acceleration=5.625).duration(90.0), 3)
        10.0
        """
        if travel < 1e-6:
            return self.pause
        speed = min(self.speed, math.sqrt(self.acceleration * travel))
        turning = 0.0 if math.isinf(speed) else travel / speed + speed / self.acceleration
        return self.pause + self.constant + turning
