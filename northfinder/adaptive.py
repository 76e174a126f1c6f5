"""A plan in the course of a measurement: designed once the stage is known, kept to its time, ended when sure enough."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from drivers.api import StageLimits
from northfinder.cyclogram import BUILT_IN, Cyclogram, Standing, Step, find_cyclogram
from northfinder.errors import ConfigError, SequenceError
from northfinder.estimation.planning import Prediction, Truth
from northfinder.layouts import MEASURE_LATITUDE, PLANS
from northfinder.plans import (
    Conditions,
    candidates,
    filled,
    following_turns,
    require_time,
    shortest_filled,
    time_of_turns,
    too_short,
)
from northfinder.reduction import MEAN_INTERVAL
from northfinder.solution import Assumptions
from northfinder.triad_plans import TRIAD_PLANS
from northfinder.turns import BLOCK_PAUSE, Turns

#: Time of a plan that fills whatever it is given, s.
DEFAULT_TIME = 300.0
#: The same where the measurement is to end at a standard deviation.
DEFAULT_TIME_UNTIL_SD = 1800.0
#: The last dwells are dropped rather than all that are left shortened below this part.
_LEAST_FACTOR = 0.5
_DEFAULT_DWELL = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """What the operator asks of a plan; None where nothing is asked. Times in s, angles in rad."""

    name: str | None = None  #: a built-in plan, or a TOML file of a cyclogram
    dwell: float | None = None  #: of each step of a built-in cyclogram; a file has dwells of its own
    time: float | None = None  #: from the first slew to the end of the last dwell
    until_sd: float | None = None  #: standard deviation of the azimuth that is enough
    azimuth: float | None = None  #: roughly known true azimuth of stage azimuth zero


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """What a plan has become for the stage at hand."""

    cyclogram: Cyclogram
    turns: Turns
    prediction: Prediction | None = None


@dataclass(slots=True, kw_only=True)
class AdaptivePlan:
    """A cyclogram whose dwells are fitted into the time left before each step; a `northfinder.sequencer.Plan`."""

    name: str
    design: Callable[[Turns], Design]
    settle: float  #: s
    time: float | None = None  #: s from the first slew; None to leave the dwells as they are
    until_sd: float | None = None  #: rad
    azimuth: float | None = None  #: rad, coarse true azimuth of stage azimuth zero
    _designed: Design | None = field(default=None, init=False)

    @property
    def n_steps(self) -> int:
        """How many steps it has; 0 before the stage is known."""
        return 0 if self._designed is None else len(self._designed.cyclogram.steps)

    def step_names(self) -> tuple[str, ...]:
        """Return the names of all steps; none before the stage is known."""
        return () if self._designed is None else tuple(step.name for step in self._designed.cyclogram.steps)

    def check(self, limits: StageLimits) -> None:
        """Design the plan for this stage. Raises ConfigError if the stage or the time does not do for it."""
        self._designed = self.design(Turns.of_stage(limits, self.settle))
        self._designed.cyclogram.check(limits)

    def next_step(self, standing: Standing) -> Step | None:
        """Return the next step, its dwell fitted into the time left; None when done, sure enough or out of time."""
        fix, designed = standing.fix, self._require_design()
        if self.until_sd is not None and fix is not None and fix.trustworthy and fix.azimuth_sd <= self.until_sd:
            return None
        azimuth = fix.azimuth if fix is not None else self.azimuth or 0.0
        steps = list(following_turns(designed.cyclogram, standing, azimuth))
        if self.time is None:
            return steps[0] if steps else None
        while steps:
            turning = time_of_turns(steps, designed.turns, standing.azimuth, standing.elevation)
            factor = (self.time - standing.elapsed - turning) / sum(step.dwell for step in steps)
            if factor >= _LEAST_FACTOR:
                dwell = _whole_means(factor * steps[0].dwell, last=len(steps) == 1)
                return replace(steps[0], dwell=dwell, deadline=self.time)
            steps.pop()
        return None

    def remaining_dwell(self, n_done: int) -> float:
        """Return how many seconds of dwell are still to come after `n_done` dwells; 0 before the stage is known."""
        return 0.0 if self._designed is None else self._designed.cyclogram.remaining_dwell(n_done)

    def outline(self) -> object:
        """Return what the record keeps of the plan."""
        designed = self._require_design()
        return {
            "name": self.name,
            "time_s": self.time,
            "until_sd_deg": None if self.until_sd is None else math.degrees(self.until_sd),
            "coarse_azimuth_deg": None if self.azimuth is None else math.degrees(self.azimuth),
            "cyclogram": designed.cyclogram,
            "predicted": designed.prediction,
        }

    def _require_design(self) -> Design:
        if self._designed is None:
            raise SequenceError(f"the plan {self.name} was asked for a step before it knew the stage")
        return self._designed


def _whole_means(dwell: float, *, last: bool) -> float:
    """Return `dwell` as so many whole means, at least one; the last one of a plan may not grow."""
    n = dwell / MEAN_INTERVAL
    return MEAN_INTERVAL * max(1, math.floor(n + 1e-6) if last else round(n))


def make_plan(
    wishes: Wishes, assumptions: Assumptions, *, settle: float, quickest: Turns | None = None
) -> AdaptivePlan:
    """Return the plan that the operator wishes for.

    Raises ConfigError if the wishes do not go together, or their time is too short for the `quickest` turns that the
    stage may turn out to make; by default those of one that turns at once.

    Without a name it is `refined`, or the published six positions if there is no noise model to plan by or a dwell is
    given. Those and four positions keep their dwells unless a time is given; all other built-in plans fill a time.
    """
    searchable = assumptions.noise() is not None and wishes.dwell is None
    name = wishes.name or ("refined" if searchable else "six-position")
    _check_wishes(name, wishes, searchable=searchable)
    _check_triad(name, wishes, assumptions)
    searched = name in PLANS and searchable and (name not in BUILT_IN or wishes.time is not None)
    time = wishes.time
    if time is None and searched:
        time = DEFAULT_TIME if wishes.until_sd is None else DEFAULT_TIME_UNTIL_SD

    if name in TRIAD_PLANS and wishes.dwell is None:
        time = wishes.time or DEFAULT_TIME

    def design(turns: Turns) -> Design:
        return (
            _searched(name, time, wishes, assumptions, turns)
            if searched and time
            else _fixed(name, time, wishes, turns)
        )

    # Complains now, rather than once the devices are open, of what no stage could do.
    quickest = quickest or Turns(pause=settle + BLOCK_PAUSE)
    if searched and time:
        require_time(name, _conditions(name, time, wishes, assumptions, quickest))
    else:
        _fixed(name, time, wishes, quickest)
    return AdaptivePlan(
        name=name,
        design=design,
        settle=settle,
        time=None if name in TRIAD_PLANS else time,  # a turn by hand may take longer, at no dwell's expense
        until_sd=wishes.until_sd,
        azimuth=wishes.azimuth,
    )


def _check_triad(name: str, wishes: Wishes, assumptions: Assumptions) -> None:
    """Raise ConfigError if too little is known, or too much asked, for a plan of a triad."""
    if name not in TRIAD_PLANS:
        return
    if wishes.until_sd is not None:
        raise ConfigError(f"the plan {name} cannot end early at a standard deviation: leave --until-sd out")
    if name == "static" and assumptions.known().bias_sd is None:
        raise ConfigError(
            "the plan static takes the biases of the gyros as zero and must know how far they may be from it: "
            "give --profile with gyro_bias_sd_dph under [errors], or turn the triad with --plan two-position"
        )


def _check_wishes(name: str, wishes: Wishes, *, searchable: bool) -> None:
    known = (*PLANS, *TRIAD_PLANS)
    if name not in known and not Path(name).exists():
        raise ConfigError(f"no plan {name!r}: expected {', '.join(known)}, or a TOML file of a cyclogram")
    if wishes.dwell is not None and wishes.time is not None:
        raise ConfigError("a dwell and a time cannot both be given: the time says how long the dwells are")
    if wishes.dwell is not None and name not in known:
        raise ConfigError(f"the plan {name} has dwells of its own: give --time to stretch them, not --dwell")
    if name == "double" and wishes.azimuth is None:
        raise ConfigError("the plan double starts from a roughly known azimuth: give --azimuth")
    if name in PLANS and name not in BUILT_IN and not searchable:
        lacking = "chooses its dwells: give --time, not --dwell" if wishes.dwell else "needs the noise: give --profile"
        raise ConfigError(f"the plan {name} {lacking}")


def _fixed(name: str, time: float | None, wishes: Wishes, turns: Turns) -> Design:
    """Return a cyclogram as it stands, or stretched to the time."""
    dwell, azimuth = wishes.dwell or _DEFAULT_DWELL, wishes.azimuth or 0.0
    cyclogram = TRIAD_PLANS[name](dwell) if name in TRIAD_PLANS else find_cyclogram(name, dwell=dwell)
    if time is None:
        return Design(cyclogram=cyclogram, turns=turns)
    stretched = filled(cyclogram, turns, time, azimuth=azimuth)
    if stretched is None:
        raise too_short(name, time, shortest_filled(cyclogram, turns, azimuth=azimuth), turns)
    return Design(cyclogram=stretched, turns=turns)


def _searched(name: str, time: float, wishes: Wishes, assumptions: Assumptions, turns: Turns) -> Design:
    """Return the best plan of that name for the time."""
    (found,) = candidates(name, _conditions(name, time, wishes, assumptions, turns))
    return Design(cyclogram=found.cyclogram, turns=turns, prediction=found.prediction)


def _conditions(name: str, time: float, wishes: Wishes, assumptions: Assumptions, turns: Turns) -> Conditions:
    """Return what a plan is searched for."""
    noise, known = assumptions.noise(), assumptions.known()
    if noise is None:
        raise SequenceError(f"the plan {name} was to be searched without a noise model")
    truth = Truth()
    truth = Truth(
        azimuth=truth.azimuth if wishes.azimuth is None else wishes.azimuth,
        latitude=truth.latitude if known.latitude is None else known.latitude,
    )
    return Conditions(
        noise=noise,
        known=known,
        turns=turns,
        time=time,
        needs_latitude=known.latitude is None and name in MEASURE_LATITUDE,
        truth=truth,
    )
