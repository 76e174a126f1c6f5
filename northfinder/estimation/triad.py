"""A triad of gyros and accelerometers at rest: analytic gyrocompassing, and double gyrocompassing over positions.

With ``u = a / |a|`` up in the body frame and ``w`` the rate, one position gives (docs/method.md, section 5, [S1] (4))

    lat = atan2(u.w, |w - (u.w) u|),  north = unit(w - (u.w) u),  east = north x u,
    azimuth of a body axis = atan2(axis.east, axis.north), its elevation = asin(axis.u)

(``sin lat = u.w / Omega`` of the source, without its need for an exact scale factor.) Biases of the gyros go into it
whole: `northfinder.estimation.double_gyrocompass` finds them from several positions.

Standard deviations are those of the outputs when each input (mean rates, mean specific forces, what is said to be
known) is moved by its own standard deviation up and down, added in squares.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from northfinder.errors import EstimateError
from northfinder.units import DPH, EARTH_RATE

Array = NDArray[np.float64]

AXES = ("x", "y", "z")
MIN_SAMPLES = 10  #: in a position
N_BATCHES = 20
#: rad; an axis nearer to the vertical has no azimuth worth the name.
VERTICAL = math.radians(1.0)
#: rad; a heading less sure than this comes from a horizontal rate that is within 3 sd of zero.
HEADING_SD_MAX = 1.0 / 3.0
#: m/s^2; at rest on the earth the specific force is within.
GRAVITY_RANGE = (9.5, 10.1)


@dataclass(frozen=True, slots=True, kw_only=True)
class StaticMean:
    """Means over one position and their standard deviations, body axes x, y, z, shape (3,) each."""

    name: str
    rate: Array  #: rad/s
    rate_sd: Array
    specific_force: Array  #: m/s^2
    specific_force_sd: Array
    n_samples: int
    degrees_of_freedom: int  #: of each standard deviation


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisDirection:
    """Where a body axis points. The azimuth is None, with the reason, where there is none."""

    azimuth: float | None  #: rad, in [0, 2 pi)
    azimuth_sd: float | None
    elevation: float  #: rad, up positive
    elevation_sd: float
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class TriadFix:
    """Latitude, and the directions of the body axes (x, y, z) in each position, from one or several positions."""

    names: tuple[str, ...]  #: of the positions
    axes: tuple[tuple[AxisDirection, AxisDirection, AxisDirection], ...]  #: a position each
    latitude: float  #: rad
    latitude_sd: float
    bias: Array | None = None  #: rad/s, shape (3,); None where one position cannot tell
    bias_sd: Array | None = None
    notes: tuple[str, ...] = ()  #: what to know before trusting a standard deviation


def static_mean(name: str, rate: ArrayLike, specific_force: ArrayLike) -> StaticMean:
    """Return the means of a position, with standard deviations that correlated noise does not fool.

    The samples are cut into 20 successive batches (fewer, of at least two samples, for a short record) and the
    standard deviation of the mean is that of the batch means over the root of their number, with one degree of freedom
    less than batches. It holds for noise correlated over much less than a twentieth of the record; for angle white
    noise, whose mean settles faster than batches show, it is on the large side. What drifts slower than the record is
    not in it.

    Parameters
    ----------
    name : str
        Name of the position.
    rate, specific_force : (n, 3) arrays
        rad/s and m/s^2, body axes, in the order of time.

    Raises
    ------
    EstimateError
        With fewer than 10 samples.
    """
    return static_mean_of(name, [np.vstack([np.asarray(rate).T, np.asarray(specific_force).T])])


def static_mean_of(name: str, pieces: Sequence[Array]) -> StaticMean:
    """Return what `static_mean` does, of samples in pieces, (6, n) each: rates and specific forces one by one."""
    n = sum(piece.shape[1] for piece in pieces)
    if n < MIN_SAMPLES:
        raise EstimateError(f"position {name!r} has {n} samples, expected at least {MIN_SAMPLES}")
    n_batches = min(N_BATCHES, n // 2)
    size = n // n_batches
    sums, start = np.zeros((6, n_batches + 1)), 0  # the last one is of what is left over
    for piece in pieces:
        first, last = (min(at // size, n_batches) for at in (start, start + piece.shape[1] - 1))
        cuts = np.maximum(np.arange(first, last + 1) * size - start, 0)
        sums[:, first : last + 1] += np.add.reduceat(piece, cuts, axis=1)
        start += piece.shape[1]
    mean = sums.sum(axis=1) / n
    sd = (sums[:, :-1] / size).std(axis=1, ddof=1) / math.sqrt(n_batches)
    return StaticMean(
        name=name,
        rate=mean[:3],
        rate_sd=sd[:3],
        specific_force=mean[3:],
        specific_force_sd=sd[3:],
        n_samples=n,
        degrees_of_freedom=n_batches - 1,
    )


def gyrocompass(mean: StaticMean, *, gyro_bias_sd: float | None = None, accelerometer_bias_sd: float = 0.0) -> TriadFix:
    """Return latitude and axis directions from one position, biases taken as zero ([S1] (4)).

    The norm of the rate should be the earth rate. Where it differs by more than noise, each gyro is taken to be wrong
    by that difference, so that the standard deviations grow, and a note says so. A bias square to the rate does not
    show in the norm.

    Parameters
    ----------
    mean : StaticMean
        From `static_mean`.
    gyro_bias_sd : float, optional
        How far each gyro's bias may be from zero, rad/s; unknown, and not in the standard deviations, if None.
    accelerometer_bias_sd : float
        The same for each accelerometer, m/s^2.

    Raises
    ------
    EstimateError
        If the specific force is not gravity, or the latitude rests on no rate at all.
    """
    check_gravity(mean)
    notes = [] if gyro_bias_sd is not None else ["gyro biases are unknown and not in the standard deviations"]
    notes += [] if accelerometer_bias_sd else ["accelerometer biases are taken as zero"]
    variance = mean.rate_sd**2 + (gyro_bias_sd or 0.0) ** 2
    norm = float(np.linalg.norm(mean.rate))
    norm_variance = float(mean.rate**2 @ variance) / norm**2 if norm else 0.0
    excess = (norm - EARTH_RATE) ** 2 - norm_variance
    if excess > 0.0:
        variance += excess
        notes.append(
            f"the rate is {norm / DPH:.3f} deg/h and the earth's {EARTH_RATE / DPH:.3f}: "
            "the difference is taken as the error of each gyro"
        )
    force_sd = np.hypot(mean.specific_force_sd, accelerometer_bias_sd)

    def outputs(inputs: Array) -> Array:
        up = unit(inputs[3:])
        horizontal = inputs[:3] - (inputs[:3] @ up) * up
        latitude = math.atan2(inputs[:3] @ up, float(np.linalg.norm(horizontal)))
        return np.array([latitude, *directions(unit(horizontal), up)])

    inputs = np.concatenate([mean.rate, mean.specific_force])
    values, sd = propagated(outputs, inputs, np.diag(np.concatenate([np.sqrt(variance), force_sd])))
    axes = axis_directions(values[1:], sd[1:])
    return TriadFix(names=(mean.name,), axes=(axes,), latitude=values[0], latitude_sd=sd[0], notes=tuple(notes))


def directions(north: Array, up: Array) -> Array:
    """Return azimuths and elevations of the body axes x, y, z."""
    azimuth = np.arctan2(np.cross(north, up), north)
    return np.concatenate([azimuth, np.arcsin(np.clip(up, -1.0, 1.0))])


def axis_directions(values: Array, sd: Array) -> tuple[AxisDirection, AxisDirection, AxisDirection]:
    """Return the directions of the axes, with no azimuth where it means nothing."""
    heading_sd = sd[int(np.argmin(np.abs(values[3:])))]
    unsure = "the horizontal rate is within 3 sd of zero" if heading_sd > HEADING_SD_MAX else ""

    def direction(i: int) -> AxisDirection:
        elevation = float(values[3 + i])
        vertical = abs(elevation) > math.pi / 2.0 - VERTICAL
        reason = "the axis is within 1 deg of vertical" if vertical else unsure
        return AxisDirection(
            azimuth=None if reason else float(values[i]) % (2.0 * math.pi),
            azimuth_sd=None if reason else float(sd[i]),
            elevation=elevation,
            elevation_sd=float(sd[3 + i]),
            reason=reason,
        )

    return direction(0), direction(1), direction(2)


def propagated(outputs: Callable[[Array], Array], inputs: Array, moves: Array) -> tuple[Array, Array]:
    """Return the outputs, all of them angles, and their standard deviations.

    `moves`, shape (k, n_inputs), are independent of each other and of one standard deviation: the diagonal matrix of
    the standard deviations where the inputs are independent, else the columns of a factor of their covariance.
    """
    values = outputs(inputs)
    variance = np.zeros_like(values)
    for step in moves[np.any(moves != 0.0, axis=1)]:
        change = outputs(inputs + step) - outputs(inputs - step)
        variance += (np.remainder(change + math.pi, 2.0 * math.pi) - math.pi) ** 2 / 4.0
    return values, np.sqrt(variance)


def unit(vector: Array) -> Array:
    """Return `vector` with norm one, or as it is if it is zero."""
    norm = float(np.linalg.norm(vector))
    return vector / norm if norm > 0.0 else vector


def check_gravity(mean: StaticMean) -> None:
    """Raise EstimateError if the specific force of `mean` is not that of a body at rest on the earth."""
    norm = float(np.linalg.norm(mean.specific_force))
    low, high = GRAVITY_RANGE
    if not low <= norm <= high:
        raise EstimateError(
            f"position {mean.name!r}: the specific force is {norm:.4g} m/s^2, expected {low} to {high}: "
            "not at rest, or another unit"
        )
