"""What a record says of how its measurement is to go on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec

from northfinder.adaptive import AdaptivePlan, Design, Wishes, make_plan
from northfinder.config import Config
from northfinder.cyclogram import Cyclogram
from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.record.facts import require_unfinished
from northfinder.solution import Assumptions
from northfinder.solve_file import kept_assumptions


@dataclass(frozen=True, slots=True, kw_only=True)
class Remainder:
    """What is needed to go on with a measurement beside its devices."""

    config: Config
    emulated: bool  #: whether the devices were an emulator that ended with the command
    assumptions: Assumptions
    plan: AdaptivePlan


class _Outline(msgspec.Struct):
    name: str
    cyclogram: Cyclogram
    time_s: float | None = None
    until_sd_deg: float | None = None
    coarse_azimuth_deg: float | None = None


def remainder_of(record: Record) -> Remainder:
    """Return how the measurement in `record` is to go on.

    The plan is the very one that was designed, not a new one: its state follows from the finished dwells.

    Raises RecordError if the measurement is complete, or the record does not hold what it takes.
    """
    require_unfinished(record)
    config = _kept(record, "config", Config)
    assumptions = kept_assumptions(record)
    settle = config.measurement.settle_s
    outline = record.meta("plan")
    plan = (
        make_plan(_kept(record, "wishes", Wishes), assumptions, settle=settle)
        if outline is None
        else _designed(_kept(record, "plan", _Outline), settle)
    )
    return Remainder(config=config, emulated=record.meta("simulation") is not None, assumptions=assumptions, plan=plan)


def _kept(record: Record, key: str, kind: type[Any]) -> Any:  # noqa: ANN401  # of the kind asked for
    try:
        return msgspec.convert(_said(record.meta(key)), kind)
    except msgspec.ValidationError as error:
        raise RecordError(f"the record {record.path} cannot be resumed: its entry {key!r} says: {error}") from None


def _said(value: Any) -> Any:  # noqa: ANN401  # any plain data
    """Return the value without the entries that say nothing: JSON has no word for the infinite limits of a stage."""
    if isinstance(value, dict):
        return {key: _said(each) for key, each in value.items() if each is not None}
    return [_said(each) for each in value] if isinstance(value, list) else value


def _designed(outline: _Outline, settle: float) -> AdaptivePlan:
    """Return the plan that was followed, whatever the stage."""
    return AdaptivePlan(
        name=outline.name,
        design=lambda turns: Design(cyclogram=outline.cyclogram, turns=turns),
        settle=settle,
        time=outline.time_s,
        until_sd=_radians(outline.until_sd_deg),
        azimuth=_radians(outline.coarse_azimuth_deg),
    )


def _radians(angle_deg: float | None) -> float | None:
    return None if angle_deg is None else math.radians(angle_deg)
