"""The plan of a measurement as data: which positions of the input axis, in which order, for how long."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from drivers.api import StageLimits
from northfinder.errors import ConfigError
from northfinder.estimation import Fix
from northfinder.record import DwellSpan
from northfinder.toml import read_toml


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One position of the input axis and how long to dwell there."""

    name: str  #: the position's name, as U1; equal names are the same position
    azimuth: float  #: rad, stage azimuth; any equivalent angle will do
    elevation: float  #: rad
    dwell: float  #: s of samples to use
    from_north: bool = False  #: whether the azimuth is a true one, to be turned to the stage's by the running estimate
    deadline: float | None = None  #: s since the first slew began; the dwell ends by then, however late it began

    def __post_init__(self) -> None:
        """Check what a stage and an estimator will rely on."""
        if not math.isfinite(self.azimuth):
            raise ValueError(f"step {self.name}: the azimuth must be a finite angle, not {self.azimuth}")
        if not abs(self.elevation) <= math.pi / 2 + 1e-9:
            raise ValueError(f"step {self.name}: the elevation must lie within -90 to 90 deg")
        if not 0.0 < self.dwell < math.inf:
            raise ValueError(f"step {self.name}: the dwell must be a positive time, not {self.dwell} s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """Where a measurement stands when its plan is asked for the next step."""

    done: tuple[DwellSpan, ...] = ()  #: the finished dwells
    fix: Fix | None = None  #: the estimate from them, None while there is none
    elapsed: float = 0.0  #: s since the first slew began
    azimuth: float = 0.0  #: rad, of the stage
    elevation: float = 0.0  #: rad, of the stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Cyclogram:
    """A sequence of steps; their true azimuths, if any, follow the running estimate."""

    name: str
    steps: tuple[Step, ...]
    symmetric: bool = False  #: whether the true azimuths may be mirrored east-west and north-south to save turning

    def __post_init__(self) -> None:
        """Refuse an empty plan."""
        if not self.steps:
            raise ValueError(f"the cyclogram {self.name} has no steps")

    @property
    def duration(self) -> float:
        """Sum of the dwells in s; slews and settling come on top."""
        return sum(step.dwell for step in self.steps)

    @property
    def n_steps(self) -> int:
        """How many steps there are."""
        return len(self.steps)

    def next_step(self, standing: Standing) -> Step | None:
        """Return the step after the finished dwells, None at the end; without an estimate stage zero is north."""
        following = self.following(standing, azimuth=standing.fix.azimuth if standing.fix else 0.0)
        return following[0] if following else None

    def following(self, standing: Standing, *, azimuth: float) -> tuple[Step, ...]:
        """Return the steps after the finished dwells in stage azimuths, given the true `azimuth` of stage zero, rad."""
        first = next((i for i, step in enumerate(self.steps) if step.from_north), None)
        following = self.steps[len(standing.done) :]
        if first is None:
            return following
        present = standing.done[first].measured_azimuth if first < len(standing.done) else standing.azimuth
        mirrors = _MIRRORS if self.symmetric else _MIRRORS[:1]
        mirror = min(
            mirrors,
            key=lambda each: abs(math.remainder(each(self.steps[first].azimuth) - azimuth - present, 2 * math.pi)),
        )
        return tuple(_on_stage(step, mirror(step.azimuth), azimuth) if step.from_north else step for step in following)

    def remaining_dwell(self, n_done: int) -> float:
        """Return the sum of the dwells after the first `n_done`, in s."""
        return sum(step.dwell for step in self.steps[n_done:])

    def outline(self) -> object:
        """Return what the record keeps of the plan."""
        return self

    def check(self, limits: StageLimits) -> None:
        """Raise ConfigError if a stage with these limits cannot take all positions of the plan."""
        if any(step.from_north for step in self.steps) and limits.azimuth_max - limits.azimuth_min < 2 * math.pi - 1e-9:
            raise ConfigError(
                f"the plan {self.name} may need any azimuth: the stage turns only from "
                f"{math.degrees(limits.azimuth_min):g} to {math.degrees(limits.azimuth_max):g} deg"
            )
        for step in self.steps:
            reachable_azimuth(step.azimuth, 0.0, limits.azimuth_min, limits.azimuth_max)
            if not limits.elevation_min - 1e-9 <= step.elevation <= limits.elevation_max + 1e-9:
                raise ConfigError(
                    f"step {step.name} at elevation {math.degrees(step.elevation):g} deg cannot be reached: the stage "
                    f"turns from {math.degrees(limits.elevation_min):g} to {math.degrees(limits.elevation_max):g} deg"
                )


_MIRRORS: tuple[Callable[[float], float], ...] = (
    lambda azimuth: azimuth,
    lambda azimuth: -azimuth,
    lambda azimuth: math.pi + azimuth,
    lambda azimuth: math.pi - azimuth,
)
_COMPASS = ("north", "east", "south", "west")


def _on_stage(step: Step, true_azimuth: float, azimuth: float) -> Step:
    """Return a step of a true azimuth as one of the stage, whose zero points to `azimuth`; named by where it points."""
    name = _COMPASS[round(true_azimuth / (math.pi / 2)) % 4] if step.name in _COMPASS else step.name
    return replace(step, name=name, azimuth=true_azimuth - azimuth, from_north=False)


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
    from_north: bool = False


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
                from_north=step.from_north,
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
