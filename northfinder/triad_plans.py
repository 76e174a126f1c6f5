"""Plans for a triad of gyros that stands on no stage: at rest, or turned by half a turn (docs/method.md, section 5)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

from drivers.api import DeviceIdentity, Gyro
from northfinder.cyclogram import Cyclogram, Step
from northfinder.errors import ConfigError


def static(dwell: float) -> Cyclogram:
    """Return one dwell as the triad stands, for analytic gyrocompassing; `dwell` in s."""
    return Cyclogram(name="static", steps=(Step(name="static", azimuth=0.0, elevation=0.0, dwell=dwell),))


def two_position(dwell: float) -> Cyclogram:
    """Return a dwell before and one after half a turn about the vertical, for double gyrocompassing; `dwell` in s."""
    steps = (Step(name=f"{degrees}", azimuth=math.radians(degrees), elevation=0.0, dwell=dwell) for degrees in (0, 180))
    return Cyclogram(name="two-position", steps=tuple(steps))


TRIAD_PLANS: dict[str, Callable[[float], Cyclogram]] = {"static": static, "two-position": two_position}


class _ForPlan:
    """A gyro that is turned away at its first words if it has too few axes for the plan."""

    def __init__(self, gyro: Gyro, plan: str) -> None:
        self._gyro = gyro
        self._plan = plan

    def connect(self) -> DeviceIdentity:
        """Open a session. Raises ConfigError for a gyro of one axis."""
        identity = self._gyro.connect()
        if self._gyro.n_axes < 3:
            raise ConfigError(
                f"the plan {self._plan} needs a triad of gyros, and the {identity.model} has one axis: "
                "turn it on a stage, with another plan"
            )
        return identity

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # hands through whatever a gyro has
        return getattr(self._gyro, name)


def fit_for(gyro: Gyro, plan: str) -> Gyro:
    """Return `gyro`, such that its `connect` raises ConfigError if it has too few axes for the plan of that name."""
    return cast("Gyro", _ForPlan(gyro, plan)) if plan in TRIAD_PLANS else gyro
