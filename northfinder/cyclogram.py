"""The plan of a measurement as data: which positions of the input axis, in which order, for how long."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from drivers.api import StageLimits
from northfinder.errors import ConfigError
from northfinder.record import DwellSpan
from northfinder.toml import read_toml


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One position of the input axis and how long to dwell there."""

    name: str  #: the position's name, as U1; equal names are the same position
    azimuth: float  #: rad, stage azimuth; any equivalent angle will do
    elevation: float  #: rad
    dwell: float  #: s of samples to use

    def __post_init__(self) -> None:
        """Check what a stage and an estimator will rely on."""
        if not math.isfinite(self.azimuth):
            raise ValueError(f"step {self.name}: the azimuth must be a finite angle, not {self.azimuth}")
        if not abs(self.elevation) <= math.pi / 2 + 1e-9:
            raise ValueError(f"step {self.name}: the elevation must lie within -90 to 90 deg")
        if not 0.0 < self.dwell < math.inf:
            raise ValueError(f"step {self.name}: the dwell must be a positive time, not {self.dwell} s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cyclogram:
    """A fixed sequence of steps."""

    name: str
    steps: tuple[Step, ...]

    def __post_init__(self) -> None:
        """Refuse an empty plan."""
        if not self.steps:
            raise ValueError(f"the cyclogram {self.name} has no steps")

    @property
    def duration(self) -> float:
        """Sum of the dwells in s; slews and settling come on top."""
        return sum(step.dwell for step in self.steps)

    def next_step(self, done: list[DwellSpan]) -> Step | None:
        """Return the step after the finished dwells, None at the end."""
        return self.steps[len(done)] if len(done) < len(self.steps) else None

    def remaining_dwell(self, done: list[DwellSpan]) -> float:
        """Return the sum of the dwells still to come, in s."""
        return sum(step.dwell for step in self.steps[len(done) :])

    def check(self, limits: StageLimits) -> None:
        """Raise ConfigError if a stage with these limits cannot take all positions of the plan."""
        for step in self.steps:
            reachable_azimuth(step.azimuth, 0.0, limits.azimuth_min, limits.azimuth_max)
            if not limits.elevation_min - 1e-9 <= step.elevation <= limits.elevation_max + 1e-9:
                raise ConfigError(
                    f"step {step.name} at elevation {math.degrees(step.elevation):g} deg cannot be reached: the stage "
                    f"turns from {math.degrees(limits.elevation_min):g} to {math.degrees(limits.elevation_max):g} deg"
                )


#: The six positions of [S2]: U1 to U4 around the horizon, U5 up, U6 down; (azimuth, elevation) in deg.
POSITIONS_DEG = {"U1": (0, 0), "U2": (90, 0), "U3": (180, 0), "U4": (270, 0), "U5": (0, 90), "U6": (0, -90)}


def reachable_azimuth(target: float, present: float, lowest: float, highest: float) -> float:
    """Return the angle equivalent to `target`, within the limits, that is nearest to `present`; all in rad.

    Raises ConfigError if no equivalent angle lies within the limits.

    >>> import math
    >>> round(math.degrees(reachable_azimuth(0.0, math.radians(270), -6.6, 6.6)))
    360
    """
    turn = 2 * math.pi
    slack = 1e-9  # a limit of exactly one turn admits a target of exactly one turn
    first = math.ceil((lowest - slack - target) / turn)
    last = math.floor((highest + slack - target) / turn)
    candidates = [target + k * turn for k in range(first, last + 1)]
    if not candidates:
        raise ConfigError(
            f"azimuth {math.degrees(target):g} deg cannot be reached: the stage turns from "
            f"{math.degrees(lowest):g} to {math.degrees(highest):g} deg"
        )
    return min(candidates, key=lambda candidate: (abs(candidate - present), abs(candidate)))


def _from_positions(name: str, order: str, dwell: float) -> Cyclogram:
    steps = []
    for position in order.split():
        azimuth_deg, elevation_deg = POSITIONS_DEG[position]
        steps.append(
            Step(name=position, azimuth=math.radians(azimuth_deg), elevation=math.radians(elevation_deg), dwell=dwell)
        )
    return Cyclogram(name=name, steps=tuple(steps))


def six_position(dwell: float = 120.0) -> Cyclogram:
    """Return the cyclogram (1) of [S2], for azimuth and latitude; `dwell` in s."""
    return _from_positions("six-position", "U1 U2 U3 U4 U1 U5 U6 U1", dwell)


def four_position(dwell: float = 120.0) -> Cyclogram:
    """Return the horizontal part of (1), for the azimuth at a known latitude; `dwell` in s."""
    return _from_positions("four-position", "U1 U2 U3 U4 U1", dwell)


BUILT_IN: dict[str, Callable[[float], Cyclogram]] = {"six-position": six_position, "four-position": four_position}


class _StepTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    name: str
    azimuth_deg: float
    elevation_deg: float
    dwell_s: float


class _CyclogramTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    name: str
    step: list[_StepTable]


def read_cyclogram(path: Path) -> Cyclogram:
    """Read a cyclogram from a TOML file: ``name`` and one ``[[step]]`` table a step.

    Raises ConfigError naming the file, the key, what was found and what was expected.
    """
    table = read_toml(path, _CyclogramTable)
    try:
        steps = tuple(
            Step(
                name=step.name,
                azimuth=math.radians(step.azimuth_deg),
                elevation=math.radians(step.elevation_deg),
                dwell=step.dwell_s,
            )
            for step in table.step
        )
        return Cyclogram(name=table.name, steps=steps)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None


def find_cyclogram(name_or_file: str, *, dwell: float = 120.0) -> Cyclogram:
    """Return the built-in cyclogram of that name (its dwells set to `dwell` s), else read the file of that name."""
    if name_or_file in BUILT_IN:
        return BUILT_IN[name_or_file](dwell)
    path = Path(name_or_file)
    if not path.exists():
        known = ", ".join(BUILT_IN)
        raise ConfigError(f"no plan {name_or_file!r}: expected {known}, or a TOML file of a cyclogram")
    return read_cyclogram(path)
