"""The built-in plans, and the search for the repetitions and dwells that make the most of a given time.

A plan is written as a layout: an opening whose dwells are as short as the pointing needs, then a pattern that fills the
time in the proportions given. Positions U1 to U6 are of the stage; north, east, south and west are true and follow the
running estimate. Successive visits of one position are one dwell, so that the order E W W E makes the first and the
last dwell half as long as the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, groupby, islice

from northfinder.cyclogram import POSITIONS_DEG, Cyclogram, Standing, Step
from northfinder.errors import ConfigError, EstimateError
from northfinder.estimation import Known, NoiseModel
from northfinder.estimation.planning import PlannedDwell, Prediction, Truth, predict
from northfinder.turns import Turns

#: Shortest dwell worth a turn, s: enough seconds in it to tell which of them are disturbed.
SHORTEST_DWELL = 5.0
#: Dwells of the opening, s, of which the first is taken that points well enough.
OPENING_DWELLS = (5.0, 8.0, 12.0, 20.0, 30.0, 45.0, 70.0, 100.0, 150.0, 240.0, 400.0)
#: Standard deviation of the azimuth times cos(latitude), rad, after an opening that points well enough.
OPENING_SD = math.radians(1.0)
#: Pairs from a known azimuth stand off the east-west line by this, rad, to measure the north part of the rate as well.
CROSSING = math.radians(8.0)
#: How much more an error of the azimuth counts than one of the latitude, where both are wanted.
AZIMUTH_WEIGHT = 2.0
#: Longest plan that is predicted from means of 1 s; a longer one from as many longer means.
N_MEANS = 960

_TRUE_DEG = {"N": ("north", 0), "E": ("east", 90), "S": ("south", 180), "W": ("west", 270)}
_LATITUDE_PATTERNS = ("EWUDNS", "EWEWUDNS", "ENUWSD")


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """A plan before the time is known: dwells are weights."""

    name: str
    opening: tuple[Step, ...] = ()
    pattern: tuple[Step, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """What a plan is made for. Times in s, angles in rad."""

    noise: NoiseModel
    known: Known
    turns: Turns
    time: float  #: from the first slew to the end of the last dwell
    needs_latitude: bool  #: whether the plan must measure the latitude
    truth: Truth


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A plan that fits the time, and how sure its fix will be."""

    cyclogram: Cyclogram
    dwells: tuple[PlannedDwell, ...]
    prediction: Prediction
    score: float  #: rad, see `_score`


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


def _refined(pattern: str, shortest: int) -> Callable[[int], Layout | None]:
    def layout(n: int) -> Layout | None:
        if n < shortest:
            return None
        return Layout(
            name="refined", opening=_stage_steps("123"), pattern=_true_steps("".join(islice(cycle(pattern), n)))
        )

    return layout


def _repeated(name: str, order: str, closing: str = "") -> Callable[[int], Layout | None]:
    return lambda n: Layout(name=name, pattern=_stage_steps(order * n + closing))


def _double(n: int) -> Layout | None:
    return Layout(name="double", pattern=_crossed_pairs(n)) if n >= 3 else None


def families(name: str, *, needs_latitude: bool) -> list[Callable[[int], Layout | None]]:
    """Return the layouts of a plan, each by the number of its repetitions or dwells.

    Raises ConfigError for a name that is no built-in plan.
    """
    if name == "refined":
        patterns = [(each, 4) for each in _LATITUDE_PATTERNS] if needs_latitude else [("EW", 2)]
        return [_refined(pattern, shortest) for pattern, shortest in patterns]
    table: dict[str, list[Callable[[int], Layout | None]]] = {
        "double": [_double],
        "six-position": [_repeated(name, "12341561")],
        "four-position": [_repeated(name, "1234", "1")],
        "drift-balanced": [_repeated(name, "13312442"), _repeated(name, "1324423131422413")],
    }
    if name not in table:
        raise ConfigError(f"no plan {name!r}: expected {', '.join(PLANS)}, or a TOML file of a cyclogram")
    return table[name]


#: Names of the built-in plans.
PLANS = ("refined", "double", "drift-balanced", "four-position", "six-position")
#: Those that turn the input axis up and down where the latitude is needed.
MEASURE_LATITUDE = ("refined", "six-position")


def timetable(cyclogram: Cyclogram, turns: Turns, azimuth: float) -> tuple[PlannedDwell, ...]:
    """Return when and where each dwell will be, the stage starting at zero, whose true azimuth is `azimuth`, rad."""
    now, at, dwells = 0.0, (0.0, 0.0), []
    for step in following_turns(cyclogram, Standing(), azimuth):
        now += turns.duration(max(abs(step.azimuth - at[0]), abs(step.elevation - at[1])))
        dwells.append(PlannedDwell(start=now, duration=step.dwell, azimuth=step.azimuth, elevation=step.elevation))
        now, at = now + step.dwell, (step.azimuth, step.elevation)
    return tuple(dwells)


def following_turns(cyclogram: Cyclogram, standing: Standing, azimuth: float) -> Iterator[Step]:
    """Yield the steps still to come, each at the equivalent azimuth that is nearest to the one before."""
    present = standing.azimuth
    for step in cyclogram.following(standing, azimuth=azimuth):
        present += math.remainder(step.azimuth - present, 2 * math.pi)
        yield replace(step, azimuth=present)


def time_of_turns(steps: Sequence[Step], turns: Turns, azimuth: float, elevation: float) -> float:
    """Return the time in s of the turns through `steps`, from the stage angles given."""
    total, at = 0.0, (azimuth, elevation)
    for step in steps:
        total += turns.duration(max(abs(step.azimuth - at[0]), abs(step.elevation - at[1])))
        at = (step.azimuth, step.elevation)
    return total


def best(name: str, conditions: Conditions) -> Candidate:
    """Return the best plan of that name for the conditions. Raises ConfigError if none of it fits the time."""
    found = [
        each
        for family in families(name, needs_latitude=conditions.needs_latitude)
        for each in _search(family, conditions)
    ]
    if not found:
        raise ConfigError(
            f"the plan {name} does not fit into {conditions.time:g} s, or determines no azimuth in that time"
        )
    return min(found, key=lambda each: each.score)


def _search(family: Callable[[int], Layout | None], conditions: Conditions) -> list[Candidate]:
    """Return candidates around the best number of repetitions: the score falls, then rises with it."""
    candidates: dict[int, Candidate | None] = {}

    def score(n: int) -> float:
        if n not in candidates:
            candidates[n] = _candidate(family, n, conditions)
        found = candidates[n]
        return math.inf if found is None else found.score

    n, most = 1, round(conditions.time / SHORTEST_DWELL)
    while n < most and (score(n) == math.inf or score(max(n + 1, round(1.4 * n))) < score(n)):
        n = max(n + 1, round(1.4 * n))
    step = max(1, round(0.4 * n))
    while step:
        better = min((n, n - step, n + step), key=lambda k: score(k) if k >= 1 else math.inf)
        n, step = (better, step) if better != n else (n, step // 2)
    return [each for each in candidates.values() if each is not None]


def _candidate(family: Callable[[int], Layout | None], n: int, conditions: Conditions) -> Candidate | None:
    """Return the layout fitted into the time, None if that cannot be or determines no azimuth."""
    layout = family(n)
    opening = None if layout is None else _opening(layout.opening, conditions)
    if layout is None or opening is None:
        return None
    cyclogram = filled(
        Cyclogram(name=layout.name, steps=opening + layout.pattern, symmetric=True),
        conditions.turns,
        conditions.time,
        azimuth=conditions.truth.azimuth,
        n_fixed=len(opening),
    )
    if cyclogram is None:
        return None
    dwells = timetable(cyclogram, conditions.turns, conditions.truth.azimuth)
    try:
        prediction = predicted(dwells, conditions)
    except EstimateError:
        return None
    score = _score(prediction, conditions)
    return None if score is None else Candidate(cyclogram=cyclogram, dwells=dwells, prediction=prediction, score=score)


def predicted(dwells: Sequence[PlannedDwell], conditions: Conditions) -> Prediction:
    """Return what the dwells will give. Raises EstimateError if they determine no azimuth."""
    end = dwells[-1].start + dwells[-1].duration
    return predict(
        dwells, conditions.noise, conditions.known, conditions.truth, interval=max(1.0, math.ceil(end / N_MEANS))
    )


def _score(prediction: Prediction, conditions: Conditions) -> float | None:
    """Return the azimuth's sd times cos(latitude); weighted and with the latitude's, in squares, where that is wanted.

    None if the latitude is wanted and not measured.
    """
    azimuth = prediction.azimuth_sd * math.cos(conditions.truth.latitude)
    if not conditions.needs_latitude:
        return azimuth
    return None if prediction.latitude_sd is None else math.hypot(AZIMUTH_WEIGHT * azimuth, prediction.latitude_sd)


def filled(cyclogram: Cyclogram, turns: Turns, time: float, *, azimuth: float, n_fixed: int = 0) -> Cyclogram | None:
    """Return the cyclogram with its dwells, but for the first `n_fixed`, stretched by one factor to end at `time`, s.

    None if a dwell would be shorter than SHORTEST_DWELL. `azimuth` is the true one of stage azimuth zero, rad.
    """
    turning = time_of_turns(tuple(following_turns(cyclogram, Standing(), azimuth)), turns, 0.0, 0.0)
    fixed, free = cyclogram.steps[:n_fixed], cyclogram.steps[n_fixed:]
    factor = (time - turning - sum(step.dwell for step in fixed)) / sum(step.dwell for step in free)
    if factor * min(step.dwell for step in free) < SHORTEST_DWELL:
        return None
    return replace(cyclogram, steps=fixed + tuple(replace(step, dwell=factor * step.dwell) for step in free))


def _opening(steps: tuple[Step, ...], conditions: Conditions) -> tuple[Step, ...] | None:
    """Return the opening with the shortest dwells that point well enough, None if a third of the time does not do."""
    if not steps:
        return ()
    for dwell in OPENING_DWELLS:
        opening = tuple(replace(step, dwell=dwell) for step in steps)
        if dwell * len(steps) > conditions.time / 3:
            return None
        dwells = timetable(Cyclogram(name="opening", steps=opening), conditions.turns, conditions.truth.azimuth)
        try:
            sd = predicted(dwells, conditions).azimuth_sd * math.cos(conditions.truth.latitude)
        except EstimateError:
            continue
        if sd <= OPENING_SD:
            return opening
    return None
