"""From what an examination has heard, and what is known of the gyro, to findings: what `northfinder doctor` says."""

from __future__ import annotations

from drivers.api import StageMode
from drivers.fixed_mount import FixedMount
from northfinder import doctor
from northfinder.adaptive import Wishes, make_plan
from northfinder.doctor import Finding
from northfinder.errors import ConfigError, EstimateError
from northfinder.estimation.planning import Truth, predict
from northfinder.examination import Examination
from northfinder.plans import timetable
from northfinder.solution import Assumptions
from northfinder.turns import Turns


def judged(
    examination: Examination, assumptions: Assumptions, wishes: Wishes, *, wanted: float | None, settle: float
) -> list[Finding]:
    """Return what follows from what the devices have sent; `wanted` is the sd of the azimuth asked for, rad."""
    found: list[Finding] = []
    stream, known = examination.stream, assumptions.known()
    if stream is None:
        found.append(doctor.skipped("samples", "the gyro could not be heard"))
    else:
        found += doctor.check_stream(stream)
        if stream.n_samples:
            noise, excess = doctor.check_noise(stream, assumptions.noise())
            found += [doctor.check_rate(stream, bias_sd=known.bias_sd), noise]
            found += doctor.check_tilt(stream, _attitude(examination), bias_sd=assumptions.accelerometer_bias_sd)
            found.append(_accuracy(examination, assumptions, wishes, wanted=wanted, excess=excess, settle=settle))
    if examination.limits is not None:
        found += doctor.check_stage(examination.states, examination.limits)
    return found


def _attitude(examination: Examination) -> tuple[float, float] | None:
    """Return where the stage stands; without one the gyro stands as it was put."""
    if examination.open_stage is None:
        return 0.0, 0.0
    state = examination.states[-1] if examination.states else None
    return None if state is None or state.mode is StageMode.NOT_HOMED else (state.azimuth, state.elevation)


def _accuracy(
    examination: Examination,
    assumptions: Assumptions,
    wishes: Wishes,
    *,
    wanted: float | None,
    excess: float,
    settle: float,
) -> Finding:
    """Return whether the plan reaches the accuracy, by the planner's own prediction."""
    noise, known, stream = assumptions.noise(), assumptions.known(), examination.stream
    if noise is None or stream is None:
        return doctor.check_accuracy(wanted, None, excess, plan="")
    limits = examination.limits
    if limits is None:
        limits = FixedMount(examination.clock).limits
    try:
        course = make_plan(wishes, assumptions, settle=settle)
        if examination.limits is None and course.name != "static":
            return doctor.skipped("accuracy", f"the plan {course.name} needs a stage, and there is none")
        turns = Turns.of_stage(limits, settle)
        cyclogram = course.design(turns).cyclogram
        truth = Truth(latitude=Truth().latitude if known.latitude is None else known.latitude)
        dwells = timetable(cyclogram, turns, truth.azimuth)
        predicted = predict(dwells, noise, known, truth, n_axes=stream.n_axes).azimuth_sd
    except (ConfigError, EstimateError) as error:
        return doctor.verdict("accuracy", str(error), passed=False)
    duration = dwells[-1].start + dwells[-1].duration
    return doctor.check_accuracy(wanted, predicted, excess, plan=f"the plan {course.name} of {duration:.0f} s")
