"""One whole measurement: sequence, record, reduction and estimate, put together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from drivers.api import Clock, Gyro, RateBlock, Stage
from northfinder.errors import EstimateError
from northfinder.estimation import Fix
from northfinder.record import DwellSpan, Record
from northfinder.record.facts import require_unfinished
from northfinder.record.recorder import Recorder
from northfinder.reduction import Reduction, reduce_record
from northfinder.sequencer import Plan, Progress, Sequencer
from northfinder.solution import Assumptions, before_offset, fix_to_json, solve, supplement
from northfinder.streams import Earlier, earlier_of


class Watcher(Protocol):
    """Shows a running measurement."""

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Show where it stands; `fix` is the estimate from the dwells finished so far, None while there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """What is to be measured, with what, and where to keep it."""

    open_gyro: Callable[[], Gyro]
    open_stage: Callable[[], Stage]
    plan: Plan
    settle: float  #: s
    assumptions: Assumptions
    record: Path
    meta: Mapping[str, object] = field(default_factory=dict)  #: kept in the record as it is
    resume: bool = False  #: go on with a record that there is


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a measurement has given."""

    fix: Fix
    record: Path
    n_samples: int
    n_lost: int
    duration: float  #: s from the first to the last sample
    supplement: Mapping[str, Any] = field(default_factory=dict)  #: reported beside the fix: budget, calibration

    def to_json(self) -> dict[str, Any]:
        """Return it as plain data, in the units of the field."""
        return (
            fix_to_json(self.fix)
            | dict(self.supplement)
            | {
                "n_samples": self.n_samples,
                "n_lost": self.n_lost,
                "duration_s": round(self.duration, 6),
                "record": str(self.record),
            }
        )


def measure(
    measurement: Measurement,
    *,
    clock: Clock,
    utc: Callable[[], float],
    watcher: Watcher,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Carry out a measurement; `utc` tells the date in s since 1970 for the record's events.

    Raises what `Sequencer.run` raises, RecordError, and EstimateError if the data determine no azimuth. The record is
    closed in every case.
    """
    with Recorder(measurement.record, utc, clock=clock.now, resume=measurement.resume) as recorder:
        earlier, reduction = _before(measurement)  # now that nobody else goes on with it
        facts = dict(measurement.meta) | {"assumptions": measurement.assumptions}
        if not measurement.resume:  # else only once the devices have shown that they are the right ones
            for key, value in facts.items():
                recorder.set_meta(key, value)
        observer = _Observer(watcher, measurement.assumptions, reduction)
        sequencer = Sequencer(
            open_gyro=measurement.open_gyro,
            open_stage=measurement.open_stage,
            plan=measurement.plan,
            recorder=recorder,
            clock=clock,
            observer=observer,
            settle=measurement.settle,
            facts=facts if measurement.resume else {},
            stop_requested=stop_requested,
            earlier=earlier,
            fix=observer.estimate() if earlier.spans else None,
        )
        sequencer.run()
        means = observer.reduction.means()
        fix = solve(means, measurement.assumptions)
        outcome = Outcome(
            fix=fix,
            record=measurement.record,
            n_samples=recorder.n_samples,
            n_lost=recorder.n_lost,
            duration=sequencer.duration,
            supplement=supplement(means, measurement.assumptions, fix),
        )
        recorder.add_fix(outcome.to_json())
    return outcome


def _before(measurement: Measurement) -> tuple[Earlier, Reduction]:
    """Return what the record of a measurement to be resumed holds, and its means; nothing for a new one.

    Raises RecordError if nothing is left to resume.
    """
    if not measurement.resume:
        return Earlier(), Reduction()
    with Record(measurement.record) as record:
        require_unfinished(record)
        return earlier_of(record), reduce_record(record)


@dataclass(slots=True)
class _Observer:
    """Reduces each dwell as it ends, and keeps the running fix."""

    watcher: Watcher
    assumptions: Assumptions
    reduction: Reduction = field(default_factory=Reduction)
    fix: Fix | None = None

    def on_progress(self, progress: Progress) -> None:
        """Show it."""
        self.watcher.show(progress, self.fix)

    def on_dwell(self, span: DwellSpan, blocks: list[RateBlock]) -> Fix | None:
        """Reduce the dwell, and estimate as soon as that is possible: for the plan, where stage azimuth zero points."""
        self.reduction.add(span, blocks)
        return self.estimate()

    def estimate(self) -> Fix | None:
        """Return the fix from the dwells so far, before the calibrated offset; None while there is none."""
        try:
            self.fix = solve(self.reduction.means(), self.assumptions)
        except EstimateError:
            self.fix = None  # too early to tell
            return None
        return before_offset(self.fix, self.assumptions)
