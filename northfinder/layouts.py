"""The built-in plans before the time is known: in which order the input axis goes where.

A layout is an opening whose dwells are as short as the pointing needs, then a pattern that fills the time in the
proportions given. Positions U1 to U6 are of the stage; north, east, south and west are true and follow the running
estimate. Successive visits of one position are one dwell, so that the order E W W E makes the first and the last dwell
half as long as the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import cycle, groupby, islice

from northfinder.cyclogram import POSITIONS_DEG, Step
from northfinder.errors import ConfigError

#: Names of the built-in plans.
PLANS = ("refined", "double", "drift-balanced", "four-position", "six-position")
#: Those that turn the input axis up and down where the latitude is needed.
MEASURE_LATITUDE = ("refined", "six-position")
#: Pairs from a known azimuth stand off the east-west line by this, rad, to measure the north part of the rate as well.
CROSSING = math.radians(8.0)

_TRUE_DEG = {"N": ("north", 0), "E": ("east", 90), "S": ("south", 180), "W": ("west", 270)}
_LATITUDE_PATTERNS = ("EWUDNS", "EWEWUDNS", "ENUWSD")


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """A plan before the time is known: dwells are weights."""

    name: str
    opening: tuple[Step, ...] = ()
    pattern: tuple[Step, ...]


#: A plan's layout by the number of its repetitions or dwells, None where there are too few of them.
Family = Callable[[int], Layout | None]


def _stage_steps(order: str) -> tuple[Step, ...]:
    """Return the positions U1 to U6 of `order`, as 13312442."""
    steps = []
    for digit, visits in groupby(order):
        azimuth, elevation = (math.radians(angle) for angle in POSITIONS_DEG[f"U{digit}"])
        steps.append(Step(name=f"U{digit}", azimuth=azimuth, elevation=elevation, dwell=float(len(list(visits)))))
    return tuple(steps)


def _true_steps(order: str) -> tuple[Step, ...]:
    """Return true positions, N E S W U(p) D(own); up and down already stand at the azimuth of what follows."""
    steps: list[Step] = []
    azimuth = math.pi / 2
    for letter in reversed(order):
        elevation = {"U": math.pi / 2, "D": -math.pi / 2}.get(letter, 0.0)
        name = {"U": "up", "D": "down"}.get(letter) or _TRUE_DEG[letter][0]
        if letter in _TRUE_DEG:
            azimuth = math.radians(_TRUE_DEG[letter][1])
        steps.append(Step(name=name, azimuth=azimuth, elevation=elevation, dwell=1.0, from_north=True))
    steps.reverse()
    return (replace(steps[0], dwell=0.5), *steps[1:-1], replace(steps[-1], dwell=0.5))


def _crossed_pairs(n: int) -> tuple[Step, ...]:
    """Return `n` dwells alternately east and west, every second pair on the other side of the east-west line."""
    side = (CROSSING, CROSSING, -CROSSING, -CROSSING)
    pairs = _true_steps("".join(islice(cycle("EW"), n)))
    return tuple(replace(step, azimuth=step.azimuth + side[i % 4]) for i, step in enumerate(pairs))


def _refined(pattern: str, shortest: int) -> Family:
    def layout(n: int) -> Layout | None:
        if n < shortest:
            return None
        return Layout(
            name="refined", opening=_stage_steps("123"), pattern=_true_steps("".join(islice(cycle(pattern), n)))
        )

    return layout


def _repeated(name: str, order: str, closing: str = "") -> Family:
    return lambda n: Layout(name=name, pattern=_stage_steps(order * n + closing))


def _double(n: int) -> Layout | None:
    return Layout(name="double", pattern=_crossed_pairs(n)) if n >= 3 else None


def families(name: str, *, needs_latitude: bool) -> list[Family]:
    """Return the layouts of a plan, each by the number of its repetitions or dwells.

    Raises ConfigError for a name that is no built-in plan.
    """
    if name == "refined":
        patterns = [(each, 4) for each in _LATITUDE_PATTERNS] if needs_latitude else [("EW", 2)]
        return [_refined(pattern, shortest) for pattern, shortest in patterns]
    table: dict[str, list[Family]] = {
        "double": [_double],
        "six-position": [_repeated(name, "12341561")],
        "four-position": [_repeated(name, "1234", "1")],
        "drift-balanced": [_repeated(name, "13312442"), _repeated(name, "1324423131422413")],
    }
    if name not in table:
        raise ConfigError(f"no plan {name!r}: expected {', '.join(PLANS)}, or a TOML file of a cyclogram")
    return table[name]
