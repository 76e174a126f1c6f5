"""What is wrong with a bench, in words: checks of what its devices said and measured, each a finding with a sentence.

Nothing here speaks to a device: `northfinder.examination` does, and hands over what it got.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from drivers.api import BusCounts, GyroStatus, RateBlock, StageLimits, StageMode, StageState
from drivers.discovery import Identification
from northfinder.errors import EstimateError
from northfinder.estimation import NoiseModel, RateMeans
from northfinder.estimation.allan import allan_curve
from northfinder.estimation.levelling import level
from northfinder.units import DPH, EARTH_RATE, MILLI_G

Array = NDArray[np.float64]

#: The sample rate may differ by this part from what the gyro says of itself.
RATE_TOLERANCE = 0.005
#: s; samples that come later than this after their time are held back by something.
LATE = 0.5
#: The Allan deviation may exceed the profile's by this factor, or stay below it by its square.
NOISE_FACTOR = 1.4
#: Probability that the band of an Allan deviation holds it: some hundred of them are looked at.
NOISE_CONFIDENCE = 0.9999
#: s; at shorter averaging times filters and quantisation rule, which no profile holds.
SHORTEST_TAU = 0.5
#: rad/s; more than this is no bias of a gyro fit for finding north.
LARGEST_BIAS = 360.0 * DPH
#: rad; more tilt than this is to be levelled out first.
LARGEST_TILT = math.radians(1.0)
#: m/s^2 about the standard one, between equator and pole, sea and mountains.
GRAVITY, GRAVITY_SPREAD = 9.80665, 0.05
#: m/s^2, of an accelerometer of which nothing is known: 20 mg.
ACCELEROMETER_BIAS = 20.0 * MILLI_G
#: rad; a stage at rest stays within, and arrives within.
AT_REST = math.radians(0.01)
AXES = "xyz"


class Verdict(Enum):
    """How a check has ended."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check and what it says to the operator."""

    name: str
    verdict: Verdict
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """What a gyro has sent in some time at rest."""

    sample_rate: float  #: Hz, as the gyro says
    n_axes: int
    blocks: tuple[RateBlock, ...]

    @property
    def n_samples(self) -> int:
        """Samples that have come."""
        return sum(len(block.counts) for block in self.blocks)

    def longest_run(self) -> Array:
        """Return the longest run of samples without a gap, rad/s, shape (n, n_axes)."""
        runs: list[list[RateBlock]] = [[]]
        for block in self.blocks:
            if runs[-1] and runs[-1][-1].first_index + len(runs[-1][-1].counts) != block.first_index:
                runs.append([])
            runs[-1].append(block)
        longest = max(runs, key=lambda run: sum(len(block.counts) for block in run))
        return np.concatenate([block.rate for block in longest]) if longest else np.empty((0, self.n_axes))


def verdict(name: str, sentence: str, *, passed: bool) -> Finding:
    """Return a finding that has passed or failed."""
    return Finding(name, Verdict.PASSED if passed else Verdict.FAILED, sentence)


def skipped(name: str, reason: str) -> Finding:
    """Return a check that could not be made, with the reason."""
    return Finding(name, Verdict.SKIPPED, reason)


def check_stream(stream: Stream) -> list[Finding]:
    """Return whether all samples have come, in time, and whether the gyro itself says that they are good."""
    if not stream.blocks:
        return [verdict("samples", "the gyro has sent no samples: is its stream switched on?", passed=False)]
    return [_losses(stream), *_timing(stream), _status(stream), _saturation(stream), _alive(stream)]


def _losses(stream: Stream) -> Finding:
    lost = sum(block.n_lost for block in stream.blocks)
    gaps = sum(block.n_lost > 0 for block in stream.blocks)
    if not lost:
        return verdict("samples", f"all {stream.n_samples} samples have come", passed=True)
    part = 100.0 * lost / (stream.n_samples + lost)
    overrun = any(block.status & GyroStatus.OVERRUN for block in stream.blocks)
    why = (
        "the gyro had no room for them: raise the baud rate or lower the sample rate"
        if overrun
        else "is the cable good, its shield grounded, the baud rate high enough, the computer not too busy?"
    )
    return verdict("samples", f"{lost} samples were lost in {gaps} gaps, {part:.2g} %: {why}", passed=False)


def _timing(stream: Stream) -> list[Finding]:
    end = np.array([block.first_index + len(block.counts) for block in stream.blocks], dtype=np.float64)
    arrival = np.array([block.arrival_time for block in stream.blocks])
    if end.size < 10 or arrival[-1] - arrival[0] < 2.0:
        return [skipped("sample rate", "too few samples have come to compare their rate with this computer's clock")]
    slope, offset = np.polyfit(end, arrival, 1)
    late = arrival - slope * end - offset
    error_sd = float(late.std()) / (float(end.std()) * math.sqrt(end.size)) / float(slope)
    rate, tolerance = 1.0 / float(slope), RATE_TOLERANCE + 3.0 * error_sd
    agrees = abs(rate / stream.sample_rate - 1.0) <= tolerance
    says = f"{rate:.6g} samples/s by this computer's clock, {stream.sample_rate:g} by the gyro's word"
    why = "" if agrees else ": is it set to another rate, or are samples lost unseen?"
    worst = float(late.max() - late.min())
    held = "" if worst <= LATE else ": the adapter, or another program on this computer, holds them back"
    return [
        verdict("sample rate", says + why, passed=agrees),
        verdict("delay", f"samples come up to {1e3 * worst:.0f} ms after their time{held}", passed=worst <= LATE),
    ]


_COMPLAINTS = {
    GyroStatus.SENSOR_FAULT: "the gyro's own supervision says that it is faulty: have it repaired",
    GyroStatus.TEMPERATURE: "the gyro is outside its operating temperature",
    GyroStatus.NOT_READY: "the gyro is still starting up: wait and try again",
}


def _status(stream: Stream) -> Finding:
    last = GyroStatus.OK
    for block in stream.blocks:
        last |= block.status
    if not stream.blocks[-1].status & GyroStatus.NOT_READY:
        last &= ~GyroStatus.NOT_READY
    for flag, sentence in _COMPLAINTS.items():
        if last & flag:
            return verdict("status", sentence, passed=False)
    warm = [block.temperature for block in stream.blocks if block.temperature is not None]
    about = f" at {warm[-1]:.1f} C" if warm else ""
    return verdict("status", f"the gyro says that it is well{about}", passed=True)


def _saturation(stream: Stream) -> Finding:
    hit = [block for block in stream.blocks if block.status & GyroStatus.SATURATED]
    if not hit:
        return verdict("range", "no axis has left its range", passed=True)
    peaks = np.max([np.abs(block.rate).max(axis=0) for block in hit], axis=0)
    axis = int(np.argmax(peaks))
    sentence = (
        f"axis {AXES[axis]} is saturated in {len(hit)} of {len(stream.blocks)} blocks, at "
        f"{math.degrees(peaks[axis]):.3g} deg/s: is the gyro being moved, or its range set too small?"
    )
    return verdict("range", sentence, passed=False)


def _alive(stream: Stream) -> Finding:
    counts = np.concatenate([block.counts for block in stream.blocks])
    frozen = [AXES[axis] for axis in np.flatnonzero(np.ptp(counts, axis=0) == 0)] if len(counts) > 100 else []
    if frozen:
        return verdict("signal", f"axis {', '.join(frozen)} gives one value only: it is dead or not read", passed=False)
    return verdict("signal", "every axis gives a living signal", passed=True)


def check_rate(stream: Stream, *, bias_sd: float | None = None) -> Finding:
    """Return whether the mean rate can be the earth's and a bias; `bias_sd`, rad/s, of each gyro if that is known."""
    mean = np.mean(stream.longest_run(), axis=0)
    norm = float(np.linalg.norm(mean))
    shown = ", ".join(f"{rate / DPH:.2f}" for rate in mean)
    worst = float(np.abs(mean).max())
    if worst > LARGEST_BIAS + EARTH_RATE:
        sentence = f"the mean rate is {shown} deg/h, far more than the earth's 15.04: is the gyro at rest?"
        return verdict("rate", sentence, passed=False)
    if stream.n_axes < 3 or bias_sd is None:
        sentence = f"the mean rate is {shown} deg/h, of which at most 15.04 are the earth's and the rest bias"
        return verdict("rate", sentence, passed=True)
    limit = 4.0 * bias_sd
    passed = abs(norm - EARTH_RATE) <= limit
    says = f"the three axes sum up to {norm / DPH:.2f} deg/h, the earth's is 15.04, biases may make {limit / DPH:.2g}"
    why = "" if passed else ": a bias is larger than the profile says, or the gyro is not at rest"
    return verdict("rate", says + why, passed=passed)


def check_noise(stream: Stream, noise: NoiseModel | None) -> tuple[Finding, float]:
    """Return whether the gyro is as quiet as its profile says, and by which factor it is surely not."""
    if noise is None or not any(getattr(noise, name) for name in noise.__slots__):
        return skipped("noise", "no profile says how noisy the gyro may be: give --profile"), 1.0
    run = stream.longest_run()
    longest = len(run) / stream.sample_rate / 6.0
    if longest < 2.0 * SHORTEST_TAU:
        return skipped("noise", "the longest run of samples without a gap is too short for an Allan deviation"), 1.0
    worst, least, where = 0.0, math.inf, (0, 0.0, 0.0)
    for axis in range(stream.n_axes):
        curve = allan_curve(run[:, axis], stream.sample_rate, noise, confidence=NOISE_CONFIDENCE)
        use = (curve.tau >= SHORTEST_TAU) & (curve.tau <= longest)
        expected = noise.allan_deviation(curve.tau)
        k = int(np.argmax(np.where(use, curve.low / expected, -1.0)))
        if curve.low[k] / expected[k] > worst:
            worst, where = float(curve.low[k] / expected[k]), (axis, float(curve.tau[k]), float(curve.deviation[k]))
        least = min(least, float(np.min(np.where(use, curve.high / expected, np.inf))))
    axis, tau, deviation = where
    says = f"the Allan deviation of axis {AXES[axis]} at {tau:.2g} s is {deviation / DPH:.3g} deg/h"
    profile = float(noise.allan_deviation(tau)) / DPH
    if worst > NOISE_FACTOR:
        why = f"{says}, the profile's {profile:.3g}: the bench shakes, or the gyro is noisier than its profile"
        return verdict("noise", why, passed=False), worst
    if least < NOISE_FACTOR**-2:
        why = f"the gyro is quieter than its profile, {least:.2g} times at the most: is it another gyro's profile?"
        return verdict("noise", why, passed=False), 1.0
    return verdict("noise", f"{says}, the profile's {profile:.3g}", passed=True), 1.0


def check_accuracy(asked: float | None, predicted: float | None, excess: float, *, plan: str) -> Finding:
    """Return whether the asked standard deviation of the azimuth, rad, can be reached by the plan with this noise."""
    if predicted is None:
        return skipped("accuracy", "what a fix will be like cannot be predicted without the gyro's noise: --profile")
    reached = predicted * excess
    says = f"{plan} will give the azimuth to {math.degrees(reached):.2g} deg"
    if asked is None:
        return verdict("accuracy", f"{says}; give --until-sd to have that judged", passed=True)
    passed = reached <= asked
    why = "" if passed else ": take more time, or a quieter gyro" + (" or bench" if excess > 1.0 else "")
    return verdict("accuracy", f"{says}, asked are {math.degrees(asked):.2g}{why}", passed=passed)


def check_tilt(stream: Stream, at: tuple[float, float] | None, *, bias_sd: float | None = None) -> list[Finding]:
    """Return whether the pedestal stands level, and whether the accelerometers read gravity, if there are any.

    Parameters
    ----------
    stream : Stream
    at : (azimuth, elevation), optional
        Of the stage meanwhile, rad; None if it is not known, as before homing.
    bias_sd : float, optional
        Of each accelerometer, m/s^2.
    """
    forces = [block.specific_force for block in stream.blocks if block.specific_force is not None]
    tilts = [
        block.tilt for block in stream.blocks if block.tilt is not None and not block.status & GyroStatus.TILT_INVALID
    ]
    found = [_gravity(np.mean(forces, axis=0), bias_sd)] if forces else []
    if tilts:
        x, y = np.mean(tilts, axis=0)
        return [*found, _level(float(x), float(y), "the tilt sensors")]
    if not forces or found[0].verdict is Verdict.FAILED:
        return [*found, skipped("tilt", "nothing measures the tilt")]
    if at is None:
        return [*found, skipped("tilt", "where the stage stands is not known before it is homed")]
    means = RateMeans(
        start=[0.0], duration=[1.0], rate=np.zeros((1, 3)), azimuth=[at[0]], elevation=[at[1]],
        specific_force=np.mean(forces, axis=0)[np.newaxis],
    )  # fmt: skip
    try:
        return [*found, _level(*level(means, bias_sd=bias_sd).tilt, "the accelerometers")]
    except EstimateError as error:
        return [*found, verdict("tilt", str(error), passed=False)]


def _gravity(force: Array, bias_sd: float | None) -> Finding:
    norm = float(np.linalg.norm(force))
    limit = GRAVITY_SPREAD + (ACCELEROMETER_BIAS if bias_sd is None else 4.0 * bias_sd)
    passed = abs(norm - GRAVITY) <= limit
    why = "" if passed else ": not at rest, another unit or range, or an accelerometer is faulty"
    says = f"the accelerometers read {norm:.4f} m/s^2, gravity is {GRAVITY:.4f} within {limit:.2g}{why}"
    return verdict("accelerometers", says, passed=passed)


def _level(x: float, y: float, by: str) -> Finding:
    passed = math.hypot(x, y) <= LARGEST_TILT
    why = "" if passed else f", more than {math.degrees(LARGEST_TILT):g}: level it"
    says = f"the pedestal leans by {math.degrees(x):.3f} and {math.degrees(y):.3f} deg by {by}{why}"
    return verdict("tilt", says, passed=passed)


def check_stage(states: Sequence[StageState], limits: StageLimits) -> list[Finding]:
    """Return whether a stage that was not asked to move stands still, free of faults and within its limits."""
    faults = sorted({state.fault or "a fault" for state in states if state.mode is StageMode.FAULT})
    if faults:
        return [
            verdict("stage", f"the stage reports {', '.join(faults)}: find the reason, then clear it", passed=False)
        ]
    if not states:
        return [skipped("stage", "the stage has not told its state")]
    if all(state.mode is StageMode.NOT_HOMED for state in states):
        return [verdict("stage", "the stage is at rest and not homed yet: find will home it", passed=True)]
    found = [verdict("stage", f"the stage is {states[-1].mode.value}, without a fault", passed=True)]
    for name in ("azimuth", "elevation"):
        angles = [getattr(state, name) for state in states]
        low, high = getattr(limits, f"{name}_min"), getattr(limits, f"{name}_max")
        moved = max(angles) - min(angles)
        if moved > AT_REST:
            sentence = f"its {name} has moved by {math.degrees(moved):.3g} deg though nobody asked: is it held?"
            found.append(verdict(name, sentence, passed=False))
        elif not low - AT_REST <= angles[-1] <= high + AT_REST:
            within = f"{math.degrees(low):g} to {math.degrees(high):g}"
            sentence = f"its {name} is {math.degrees(angles[-1]):.3f} deg, outside its limits of {within}"
            found.append(verdict(name, sentence, passed=False))
        else:
            found.append(verdict(name, f"its {name} rests at {math.degrees(angles[-1]):.3f} deg", passed=True))
    return found


def explain_link(device: str, found: Identification, *, baudrate: int | None) -> Finding:
    """Return why a device on a serial port or socket could not be spoken to, from who was recognised there instead.

    Parameters
    ----------
    device : str
        DRIVER:ADDRESS as the bench has it.
    found : Identification
        What listening and asking at every baud rate has found there.
    baudrate : int, optional
        As the bench has it, None for the driver's own.
    """
    driver, _, port = device.partition(":")
    if found.identity is None:
        return verdict("port", found.remark, passed=False)
    other, _, _ = found.address.partition(":")
    who = f"a {found.identity.kind}, {found.identity.model}, answers on {port}"
    if other != driver:
        return verdict("port", f"{who}, and its driver is {other}: write {found.address} for {device}", passed=False)
    if found.baudrate is not None and found.baudrate != baudrate:
        rate = "the driver's own rate" if baudrate is None else f"{baudrate}"
        return verdict("port", f"{who} at {found.baudrate} bit/s, not at {rate}: set baudrate to that", passed=False)
    return verdict("port", f"{who} now: try again; another program may have used the port", passed=False)


def check_bus(before: BusCounts, after: BusCounts) -> Finding:
    """Return whether a CAN bus is sound, by what was heard on it meanwhile."""
    frames, errors = after.n_frames - before.n_frames, after.n_errors - before.n_errors
    if errors:
        sentence = (
            f"{errors} error frames came beside {frames} good ones: is there a terminating resistor of 120 ohm at both "
            "ends of the cable, and nowhere else; is the bit rate that of all nodes; is the cable whole?"
        )
        return verdict("bus", sentence, passed=False)
    if malformed := after.n_malformed - before.n_malformed:
        return verdict("bus", f"the adapter has sent {malformed} lines that are no frame", passed=False)
    if not frames:
        return verdict(
            "bus", "nothing is heard on the bus: power, the two terminating resistors, bit rate", passed=False
        )
    return verdict("bus", f"{frames} frames and no error on the bus", passed=True)
