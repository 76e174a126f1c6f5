"""A campaign: many records of one instrument at one place, in order, by turn-ons, before and after a pause."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from northfinder.errors import ConfigError, EstimateError
from northfinder.estimation import Fix, Known, RateMeans, solve_closed_form
from northfinder.estimation.campaign import (
    longest_gap,
)
from northfinder.record import Record
from northfinder.record.facts import RecordFacts, facts_of, require_complete
from northfinder.reduction import reduce_record
from northfinder.solution import Assumptions, Problem, solve
from northfinder.solve_file import kept_assumptions

Array = NDArray[np.float64]
_HOUR = 3600.0  # s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Member:
    """One measurement of a campaign."""

    path: Path
    facts: RecordFacts
    fix: Fix  #: as `find` stated it, or as asked for anew
    plain: Fix  #: the same data with nothing known beforehand
    bias: tuple[float, float] | None  #: rad/s, of the horizontal and the vertical plane by (10); None without them
    known_latitude: float | None  #: rad, with which it was measured
    truth: tuple[float, float] | None  #: rad, the emulator's azimuth and latitude


def read_member(path: Path, revise: Callable[[Assumptions], Assumptions] = lambda kept: kept) -> Member:
    """Read and estimate one record. Raises RecordError, and EstimateError naming the record."""
    with Record(path) as record:
        require_complete(record)
        assumptions = revise(kept_assumptions(record))
        facts = facts_of(record)
        simulation = record.meta("simulation")
        try:
            means = reduce_record(record).means()
            fix = solve(means, assumptions)
            plain = Problem.of(means, assumptions).estimate(Known())
        except EstimateError as error:
            raise EstimateError(f"{path}: {error}") from None
    known_deg = assumptions.latitude_deg
    return Member(
        path=path,
        facts=facts,
        fix=fix,
        plain=plain,
        bias=_plane_biases(means),
        known_latitude=None if known_deg is None else math.radians(known_deg),
        truth=_truth(simulation),
    )


def _truth(simulation: object) -> tuple[float, float] | None:
    """Return azimuth and latitude of the emulator, None on a real bench."""
    try:
        table = msgspec.convert(simulation, dict[str, Any])
        return math.radians(float(table["azimuth_deg"])), math.radians(float(table["latitude_deg"]))
    except (msgspec.ValidationError, KeyError, TypeError, ValueError):
        return None


def _plane_biases(means: RateMeans) -> tuple[float, float] | None:
    """Return the half sums of (10), None unless all six positions were measured."""
    try:
        found = solve_closed_form(means)
    except EstimateError:
        return None
    return None if found.bias_vertical is None else (found.bias_horizontal, found.bias_vertical)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Campaign:
    """Measurements in order of time, with the turn-on of each, and where the pause came."""

    members: tuple[Member, ...]
    turn_on: NDArray[np.int64]  #: (n,), from 0
    pause_after: int | None  #: index of the last measurement before the pause
    latitude: float | None  #: rad, the true one
    azimuth: float | None  #: rad, the true one

    def part(self, name: str) -> NDArray[np.bool_]:
        """Return which members are in the part "all", "before" or "after" the pause, shape (n,)."""
        order = np.arange(len(self.members))
        last = len(order) - 1 if self.pause_after is None else self.pause_after
        return {"all": order >= 0, "before": order <= last, "after": order > last}[name]

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts there are."""
        return ("all",) if self.pause_after is None else ("all", "before", "after")

    def values(self, value: Callable[[Member], float | None]) -> Array:
        """Return a value of each member, nan where it has none, shape (n,)."""
        return np.array([value(member) for member in self.members], dtype=np.float64)


def gather(
    members: Sequence[Member],
    *,
    pause_hours: float | None = None,
    latitude: float | None = None,
    azimuth: float | None = None,
) -> Campaign:
    """Put measurements in order of time and find turn-ons and pause.

    Parameters
    ----------
    members : sequence of Member
        At least two.
    pause_hours : float, optional
        The first gap at least this long is the pause; if not given, a gap ten times the others.
    latitude, azimuth : float, optional
        The true ones, rad; if not given the emulator's, or the latitude all were measured with.

    Raises
    ------
    ConfigError
        There are too few measurements, or no gap is as long as the pause asked for.
    """
    if len(members) < 2:
        raise ConfigError(f"a campaign has at least two measurements, not {len(members)}")
    ordered = sorted(members, key=lambda member: (member.facts.started, member.facts.device_times))
    facts = [member.facts for member in ordered]
    new = [not later.same_turn_on(earlier) for earlier, later in pairwise(facts)]
    gaps = [(later.started - earlier.ended) / _HOUR for earlier, later in pairwise(facts)]
    pause = longest_gap(gaps, least=pause_hours)
    if pause is None and pause_hours is not None:
        raise ConfigError(f"no pause of {pause_hours:g} h: the longest between two measurements is {max(gaps):.3g} h")
    truths = {member.truth for member in ordered}
    truth = truths.pop() if len(truths) == 1 else None
    known = {member.known_latitude for member in ordered}
    common = known.pop() if len(known) == 1 else None
    return Campaign(
        members=tuple(ordered),
        turn_on=np.concatenate([[0], np.cumsum(new)]).astype(np.int64),
        pause_after=pause,
        latitude=next((each for each in (latitude, truth[1] if truth else None, common) if each is not None), None),
        azimuth=azimuth if azimuth is not None or truth is None else truth[0],
    )
