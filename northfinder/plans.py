"""The search for the repetitions and dwells of a built-in plan that make the most of a given time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from northfinder.cyclogram import Cyclogram, Standing, Step
from northfinder.errors import ConfigError, EstimateError
from northfinder.estimation import Known, NoiseModel
from northfinder.estimation.planning import PlannedDwell, Prediction, Truth, predict
from northfinder.layouts import Family, families
from northfinder.turns import Turns

#: Shortest dwell worth a turn, s: enough seconds in it to tell which of them are disturbed.
SHORTEST_DWELL = 5.0
#: Dwells of the opening, s, of which the first is taken that points well enough.
OPENING_DWELLS = (5.0, 8.0, 12.0, 20.0, 30.0, 45.0, 70.0, 100.0, 150.0, 240.0, 400.0)
#: Standard deviation of the azimuth times cos(latitude), rad, after an opening that points well enough.
OPENING_SD = math.radians(1.0)
#: The same where the gyro allows no better: pairs that stand so far off see 4 % less.
COARSEST_OPENING_SD = math.radians(15.0)
#: The longest time that a plan is ever given, s.
LONGEST_TIME = 3600.0
#: How much more an error of the azimuth counts than one of the latitude, where both are wanted.
AZIMUTH_WEIGHT = 2.0
#: Repetitions or dwells of which one is enough to tell whether a plan fits a time at all.
_FEW = (1, 2, 3, 4, 6, 8)
#: A search predicts from about this many means at most, of whole seconds; what it finds is predicted from means of 1 s.
N_MEANS = 480


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


def candidates(name: str, conditions: Conditions, *, n: int = 1) -> list[Candidate]:
    """Return the `n` best plans of that name for the conditions, the best first.

    Raises ConfigError if none of that name fits the time and determines an azimuth in it.
    """
    found = [
        each
        for family in families(name, needs_latitude=conditions.needs_latitude)
        for each in _search(family, conditions)
    ]
    if not found:
        raise too_short(name, conditions.time, shortest_time(name, conditions), conditions.turns)
    shortlist = sorted(found, key=lambda each: each.score)[:n]
    return sorted((_predicted_exactly(each, conditions) for each in shortlist), key=lambda each: each.score)


def require_time(name: str, conditions: Conditions) -> None:
    """Raise ConfigError if no plan of that name fits the time of the conditions and determines an azimuth in it."""
    if not _fits(name, conditions):
        raise too_short(name, conditions.time, shortest_time(name, conditions), conditions.turns)


def too_short(name: str, time: float, shortest: float | None, turns: Turns) -> ConfigError:
    """Return what to say of a time that a plan does not fit into, and of the `shortest` that it would; both in s."""
    if shortest is None:
        return ConfigError(
            f"the plan {name} determines no azimuth in {time:g} s, nor in any time up to {LONGEST_TIME:g} s, with this "
            "gyro on this stage"
        )
    presumed = "" if math.isfinite(turns.acceleration) else ", more on a slow stage"
    return ConfigError(f"the plan {name} does not fit into {time:g} s: it takes at least {shortest:g} s{presumed}")


def shortest_time(name: str, conditions: Conditions) -> float | None:
    """Return the shortest time in whole s, longer than that of the conditions, that a plan of that name needs.

    None if not even LONGEST_TIME is enough for the noise and the stage.
    """
    too_little, enough = math.floor(conditions.time), math.floor(LONGEST_TIME)
    if not _fits(name, replace(conditions, time=enough)):
        return None
    while enough - too_little > 1:
        middle = (too_little + enough) // 2
        if _fits(name, replace(conditions, time=middle)):
            enough = middle
        else:
            too_little = middle
    return enough


def _fits(name: str, conditions: Conditions) -> bool:
    """Return whether any plan of that name fits the time and determines an azimuth in it; fewest dwells first."""
    counts = [n for n in _FEW if n <= max(1.0, conditions.time / SHORTEST_DWELL)]
    layouts = ((family, n) for family in families(name, needs_latitude=conditions.needs_latitude) for n in counts)
    return any(_candidate(family, n, conditions) is not None for family, n in layouts)


def _search(family: Family, conditions: Conditions) -> list[Candidate]:
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


def _candidate(family: Family, n: int, conditions: Conditions) -> Candidate | None:
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
        prediction = predicted(dwells, conditions, interval=_interval(conditions))
    except EstimateError:
        return None
    score = _score(prediction, conditions)
    return None if score is None else Candidate(cyclogram=cyclogram, dwells=dwells, prediction=prediction, score=score)


def _interval(conditions: Conditions) -> float:
    """Return the length of the means that a search predicts from, s."""
    return max(1.0, math.ceil(conditions.time / N_MEANS))


def _predicted_exactly(candidate: Candidate, conditions: Conditions) -> Candidate:
    prediction = predicted(candidate.dwells, conditions)
    return replace(candidate, prediction=prediction, score=_score(prediction, conditions) or math.inf)


def predicted(dwells: Sequence[PlannedDwell], conditions: Conditions, *, interval: float = 1.0) -> Prediction:
    """Return what the dwells will give. Raises EstimateError if they determine no azimuth."""
    return predict(dwells, conditions.noise, conditions.known, conditions.truth, interval=interval)


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


def shortest_filled(cyclogram: Cyclogram, turns: Turns, *, azimuth: float) -> float:
    """Return the shortest time in whole s for which `filled` gives a cyclogram."""
    turning = time_of_turns(tuple(following_turns(cyclogram, Standing(), azimuth)), turns, 0.0, 0.0)
    dwells = [step.dwell for step in cyclogram.steps]
    return math.ceil(turning + SHORTEST_DWELL * sum(dwells) / min(dwells))


@lru_cache(maxsize=16)
def _opening(steps: tuple[Step, ...], conditions: Conditions) -> tuple[Step, ...] | None:
    """Return the opening with the shortest dwells that point well, else what a third of the time gives.

    None if even that points worse than COARSEST_OPENING_SD.
    """
    if not steps:
        return ()
    found = None
    for dwell in OPENING_DWELLS:
        if dwell * len(steps) > conditions.time / 3:
            break
        opening = tuple(replace(step, dwell=dwell) for step in steps)
        dwells = timetable(Cyclogram(name="opening", steps=opening), conditions.turns, conditions.truth.azimuth)
        try:
            sd = predicted(dwells, conditions).azimuth_sd * math.cos(conditions.truth.latitude)
        except EstimateError:
            continue
        if sd <= OPENING_SD:
            return opening
        if sd <= COARSEST_OPENING_SD:
            found = opening
    return found
