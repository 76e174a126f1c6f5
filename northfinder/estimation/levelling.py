"""How a pedestal leans, from the accelerometers of the triad that it carries (docs/method.md, section 5).

In pedestal axes (stage azimuth zero, stage azimuth 90 deg, down) gravity's reaction ``f`` is one vector, whatever the
stage does. The accelerometers along the axes ``H`` of the stage's head read

    a = H(azimuth, elevation) f + b + noise,

which is linear in ``f`` and in their biases ``b``: least squares over all attitudes, each bias being zero within its
standard deviation. Turning about the vertical takes the biases of the level axes out of the tilt; at one attitude they
go into it whole. The norm of ``f`` is free, so gravity need not be known and a common scale factor does no harm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from northfinder.errors import EstimateError
from northfinder.estimation.geometry import head_axes
from northfinder.estimation.means import RateMeans
from northfinder.estimation.triad import GRAVITY_RANGE

Array = NDArray[np.float64]

#: m/s^2, of accelerometers of which nothing is said, where several attitudes can tell their biases: 50 mg.
UNKNOWN_BIAS_SD = 0.5
#: m/s^2, the least that means of accelerometers are taken to scatter: a micro-g.
LEAST_SD = 1e-5
#: Attitudes closer than this, rad, are one.
SAME_ATTITUDE = math.radians(1.0)
#: rad; further over, the axis at stage azimuth zero no longer says where a body points.
LARGEST_TILT = math.radians(60.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levelling:
    """The tilt of a pedestal and what was found of the accelerometers beside it."""

    tilt: tuple[float, float]  #: rad, as in the convention sheet of ``northfinder``
    tilt_sd: float  #: rad, the larger one of the two directions
    specific_force: float  #: m/s^2, gravity as measured
    bias: Array  #: m/s^2, of each accelerometer, shape (3,)
    bias_sd: Array  #: m/s^2
    n_attitudes: int

    @property
    def twist(self) -> float:
        """Azimuth, rad, of the level projection of stage azimuth zero less that of the pedestal turned level."""
        angle = math.hypot(*self.tilt)
        if angle == 0.0:
            return 0.0
        across, along = self.tilt[1] / angle, self.tilt[0] / angle
        # Stage azimuth zero after the rotation by `angle` about (across, -along, 0): Rodrigues' formula.
        x = math.cos(angle) + across**2 * (1.0 - math.cos(angle))
        y = -across * along * (1.0 - math.cos(angle))
        return math.atan2(y, x)


def level(means: RateMeans, *, bias_sd: float | None = None) -> Levelling:
    """Return the tilt of the pedestal from the specific force in `means`.

    Parameters
    ----------
    means : RateMeans
        With a specific force; the tilt in them is not used.
    bias_sd : float, optional
        Each accelerometer's bias is zero within it, m/s^2. If not given, it is taken as zero where there is but one
        attitude, and as 50 mg where there are several to tell it.

    Raises
    ------
    EstimateError
        If the specific force is not that of a body at rest on the earth, or the pedestal leans by more than 60 deg.
    """
    dwells = means.per_dwell()
    n_attitudes = _count(head_axes(dwells.azimuth, dwells.elevation))
    if bias_sd is None:
        bias_sd = UNKNOWN_BIAS_SD if n_attitudes > 1 else 0.0
    noise_sd = _noise_sd(means, dwells)
    axes = head_axes(dwells.azimuth, dwells.elevation)
    matrix = np.hstack([axes.reshape(-1, 3), np.tile(np.eye(3), (dwells.n, 1))]) / noise_sd
    known = np.hstack([np.zeros((3, 3)), np.eye(3)]) / max(bias_sd, LEAST_SD * 1e-3)
    values = np.concatenate([dwells.specific_force.ravel() / noise_sd, np.zeros(3)])
    rows = np.vstack([matrix, known])
    found, *_ = np.linalg.lstsq(rows, values, rcond=None)
    covariance = np.linalg.inv(rows.T @ rows)
    chi2, dof = float(np.sum((values - rows @ found) ** 2)), max(3 * dwells.n - 3, 1)
    return _levelling(found, np.asarray(covariance * max(1.0, chi2 / dof)), n_attitudes)


def _levelling(found: Array, covariance: Array, n_attitudes: int) -> Levelling:
    force, norm = found[:3], float(np.linalg.norm(found[:3]))
    if not GRAVITY_RANGE[0] <= norm <= GRAVITY_RANGE[1]:
        low, high = GRAVITY_RANGE
        raise EstimateError(
            f"the accelerometers read {norm:.4g} m/s^2, expected {low} to {high}: not at rest, or badly calibrated"
        )
    across, down = math.hypot(force[0], force[1]), float(force[2])
    angle = math.atan2(across, -down)
    if angle > LARGEST_TILT:
        raise EstimateError(
            f"the third axis leans {math.degrees(angle):.0f} deg from straight down, expected at most "
            f"{math.degrees(LARGEST_TILT):.0f}: mount the triad with its third axis down"
        )
    per_force = angle / across if across else 1.0 / norm
    across_variance = max(float(covariance[0, 0]), float(covariance[1, 1]))
    tilt_sd = math.sqrt(across_variance + angle**2 * float(covariance[2, 2])) / norm
    return Levelling(
        tilt=(-per_force * float(force[0]), -per_force * float(force[1])),
        tilt_sd=tilt_sd,
        specific_force=norm,
        bias=found[3:],
        bias_sd=np.sqrt(np.diag(covariance)[3:]),
        n_attitudes=n_attitudes,
    )


def _noise_sd(means: RateMeans, dwells: RateMeans) -> float:
    """Return the standard deviation of a dwell's mean, from how the means within dwells scatter."""
    run = np.searchsorted(dwells.start, means.start, side="right") - 1
    scatter = means.specific_force - dwells.specific_force[run]
    freedom = means.n - dwells.n
    if freedom < 1:
        return LEAST_SD
    of_mean = math.sqrt(float(np.sum(scatter**2)) / (3 * freedom))
    return max(of_mean / math.sqrt(means.n / dwells.n), LEAST_SD)


def _count(axes: Array) -> int:
    found: list[Array] = []
    for each in axes:
        if all(np.linalg.norm(each - other) > SAME_ATTITUDE for other in found):
            found.append(each)
    return len(found)
