"""What a record tells of itself beside its rates: which gyro, when, how warm."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import Any

import msgspec

from drivers.api import DeviceIdentity
from northfinder.errors import RecordError
from northfinder.record import Record


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordFacts:
    """Where a record comes from."""

    gyro: DeviceIdentity | None  #: None if the measurement ended before it was known
    started: float  #: s since 1970, UTC
    ended: float  #: likewise
    device_times: tuple[float, float]  #: of the first and the last block by the gyro's own clock, s since its start
    temperatures: tuple[float, float] | None  #: lowest and highest, degrees Celsius; None if none was measured

    def same_turn_on(self, before: RecordFacts) -> bool:
        """Return whether the gyro was not switched off since the record `before` this one."""
        if self.gyro is None or before.gyro is None:
            return False
        same = (self.gyro.serial_number, self.gyro.boot_count) == (before.gyro.serial_number, before.gyro.boot_count)
        return same and self.device_times[0] >= before.device_times[1]

    @property
    def date(self) -> dt.date:
        """Day of the measurement, UTC."""
        return dt.datetime.fromtimestamp(self.ended, dt.UTC).date()


def facts_of(record: Record) -> RecordFacts:
    """Return what `record` tells of itself. Raises RecordError."""
    started, ended = _times(record)
    times, warm = [], []
    for block in record.blocks():
        times.append(block.device_time)
        warm += [] if block.temperature is None else [block.temperature]
    if not times:
        raise RecordError(f"the record {record.path} holds no samples")
    return RecordFacts(
        gyro=gyro_identity(record),
        started=started,
        ended=ended,
        device_times=(times[0], times[-1]),
        temperatures=(min(warm), max(warm)) if warm else None,
    )


def require_complete(record: Record) -> None:
    """Raise RecordError if the measurement ended before its fix: such data are not to be averaged with others."""
    if not record.is_complete():
        raise RecordError(
            f"the record {record.path} ends before its measurement did, after {_steps_done(record)}: "
            "expected one of a whole measurement, with its fix"
        )


def require_unfinished(record: Record) -> None:
    """Raise RecordError if the measurement went on to its fix: there is nothing to go on with."""
    if record.is_complete():
        raise RecordError(f"the record {record.path} holds a whole measurement: nothing is left to resume")


def completeness(record: Record) -> dict[str, Any]:
    """Return whether the record holds a whole measurement, and how much of it in words."""
    return {"complete": record.is_complete(), "steps": _steps_done(record)}


def _steps_done(record: Record) -> str:
    """Return how many steps were finished, of how many if the plan tells.

    An outline holds the steps itself or in its cyclogram.
    """
    plan = record.meta("plan")
    outline = (plan.get("cyclogram") or plan) if isinstance(plan, dict) else None
    steps = outline.get("steps") if isinstance(outline, dict) else None
    planned = len(steps) if isinstance(steps, list) else 0
    return f"{len(record.steps())} of the {planned} steps" if planned else f"{len(record.steps())} steps"


def gyro_identity(record: Record) -> DeviceIdentity | None:
    """Return who the gyro said it was, None if the record does not hold it. Raises RecordError."""
    identities = record.meta("identities")
    if identities is None:
        return None
    try:
        return msgspec.convert(identities, dict[str, DeviceIdentity]).get("gyro")
    except msgspec.ValidationError as error:
        raise RecordError(f"the record {record.path} is damaged: its identities cannot be read: {error}") from None


def record_date(record: Record) -> dt.date:
    """Return the day on which the record ended, UTC. Raises RecordError if it holds no event."""
    return dt.datetime.fromtimestamp(_times(record)[1], dt.UTC).date()


def _times(record: Record) -> tuple[float, float]:
    """Return when the first and the last event were, s since 1970."""
    events = record.events()
    if not events:
        raise RecordError(f"the record {record.path} holds no event, so it has no date")
    return events[0][0], events[-1][0]
