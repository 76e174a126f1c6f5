"""The uncertainty budget of a fix, in the form of the GUM (JCGM 100:2008, 5.1; docs/method.md, section 8).

Each contribution is a standard uncertainty of a quantity times how strongly azimuth and latitude follow it; the root of
the sum of their squares is the standard deviation that the fix states.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from northfinder.estimation.fix import Fix, Known
from northfinder.estimation.geometry import by_tilt
from northfinder.estimation.least_squares import Weights
from northfinder.estimation.linear import Drift
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel
from northfinder.estimation.propagation import Gains, Propagation, gains

Array = NDArray[np.float64]

#: Kinds of noise as people call them, and the SI units of their coefficients.
NOISE_KINDS = {
    "angle_white_noise": ("angle white noise", "rad"),
    "angle_random_walk": ("angle random walk", "rad/sqrt(s)"),
    "bias_instability": ("bias instability", "rad/s"),
    "rate_random_walk": ("rate random walk", "rad/s/sqrt(s)"),
    "rate_ramp": ("rate ramp", "rad/s^2"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Declared:
    """Standard deviations that the data cannot show and that `Known` does not hold; zero where nothing is declared."""

    stage_angle_sd: float = 0.0  #: rad, of either stage angle at a position, the same at each visit
    turn_sd: float = 0.0  #: rad, of the turn from one position to the next by hand, about the vertical
    misalignment_sd: float = 0.0  #: rad, of the input axis, either way
    azimuth_offset: float = 0.0  #: rad, calibrated, taken off the azimuth already
    azimuth_offset_sd: float | None = None  #: rad, None if it was not calibrated
    scale_drift_correlation: float = 0.0  #: of the known scale factor and acceleration-sensitive drift rate
    ratio: float = 1.0  #: k of (12), put on the vertical rate already
    ratio_sd: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Contribution:
    """One line of the budget."""

    quantity: str
    sd: float  #: standard uncertainty of the quantity, in `unit`
    unit: str  #: SI
    evaluation: Literal["A", "B"]  #: from the statistics of observations, or from other knowledge
    azimuth: float  #: rad, standard uncertainty it brings to the azimuth
    latitude: float  #: rad, likewise; zero where there is no latitude

    @property
    def azimuth_sensitivity(self) -> float | None:
        """Sensitivity coefficient, rad per unit, without sign; None where the quantity is taken as exact."""
        return self.azimuth / self.sd if self.sd else None

    @property
    def latitude_sensitivity(self) -> float | None:
        """Sensitivity coefficient, rad per unit, without sign; None where the quantity is taken as exact."""
        return self.latitude / self.sd if self.sd else None


@dataclass(frozen=True, slots=True)
class Budget:
    """All contributions, the largest to the azimuth first."""

    contributions: tuple[Contribution, ...]

    @property
    def azimuth_sd(self) -> float:
        """Combined standard uncertainty of the azimuth, rad."""
        return math.hypot(*(line.azimuth for line in self.contributions))

    @property
    def latitude_sd(self) -> float:
        """Combined standard uncertainty of the latitude, rad."""
        return math.hypot(*(line.latitude for line in self.contributions))


def error_budget(
    means: RateMeans,
    fix: Fix,
    *,
    noise: NoiseModel | None,
    known: Known,
    drift: Drift = "constant",
    weights: Weights = "ordinary",
    declared: Declared | None = None,
) -> Budget:
    """Return the budget of a fix that `estimate` made with the same arguments.

    Parameters
    ----------
    means, noise, known, drift, weights
        As given to `estimate`.
    fix : Fix
        What it returned, the declared uncertainties added or not.
    declared : Declared, optional
        What `estimate` does not know of.

    Raises
    ------
    EstimateError
        As `estimate`.
    """
    declared = declared or Declared()
    path = Propagation.of(means, noise=noise, known=known, drift=drift, weights=weights)
    fix, gain = _through_ratio(path, fix, known, declared)
    lines = [*_noise_lines(path, fix, gain), *_known_lines(path, fix, known, gain, declared)]
    lines += _declared_lines(path, fix, known, gain, declared)
    return Budget(tuple(sorted(lines, key=lambda line: (-line.azimuth, -line.latitude))))


def declared_variance(
    means: RateMeans, fix: Fix, *, noise: NoiseModel | None, known: Known, drift: Drift, weights: Weights,
    declared: Declared,
) -> Array:  # fmt: skip
    """Return what the declared uncertainties add to the variances of (azimuth, latitude), rad^2, shape (2,).

    Parameters as for `error_budget`. The correlation of two known quantities may take something off.
    """
    beside = (declared.stage_angle_sd, declared.turn_sd, declared.misalignment_sd, declared.azimuth_offset_sd)
    if not any(beside) and not declared.scale_drift_correlation:
        return np.zeros(2)
    path = Propagation.of(means, noise=noise, known=known, drift=drift, weights=weights)
    fix, gain = _through_ratio(path, fix, known, declared)
    lines = _declared_lines(path, fix, known, gain, declared)
    added = np.sum([(line.azimuth**2, line.latitude**2) for line in lines], axis=0)
    covariance = declared.scale_drift_correlation * known.scale_factor_sd * known.acceleration_sensitive_drift_rate_sd
    return np.asarray(added - 2.0 * gain.scale_factor * gain.rates[:, 2] * covariance)


def _through_ratio(path: Propagation, fix: Fix, known: Known, declared: Declared) -> tuple[Fix, Gains]:
    """Return the fix with its rates as measured, before the ratio k, and the gains of those."""
    gain = gains(fix, known, azimuth=fix.azimuth + declared.azimuth_offset, vertical=path.vertical)
    planes = np.array([1.0, 1.0, declared.ratio if path.vertical else 1.0])
    return replace(fix, rates=fix.rates / planes), replace(gain, rates=gain.rates * planes)


def _line(quantity: str, sd: float, unit: str, evaluation: Literal["A", "B"], by: Iterable[Array]) -> Contribution:
    """Return the contribution of independent errors of the quantity, each given by its (azimuth, latitude) in rad."""
    azimuth, latitude = np.linalg.norm(np.column_stack([np.zeros(2), *by]), axis=1)
    return Contribution(
        quantity=quantity, sd=sd, unit=unit, evaluation=evaluation, azimuth=float(azimuth), latitude=float(latitude)
    )


def _of_covariance(quantity: str, sd: float, unit: str, rates_covariance: Array, gain: Gains) -> Contribution:
    variance = np.maximum(np.diag(gain.rates @ rates_covariance @ gain.rates.T), 0.0)
    return _line(quantity, sd, unit, "A", [np.sqrt(variance)])


def _noise_lines(path: Propagation, fix: Fix, gain: Gains) -> list[Contribution]:
    """Return the noise by kind, or as the residuals show it; the price of following a drift apart."""
    if path.noise is not None:
        factor = fix.rescaled_by
        return [
            _of_covariance(name, factor * getattr(path.noise, kind), unit, factor**2 * cov, gain)
            for kind, cov in path.noise_covariances().items()
            for name, unit in [NOISE_KINDS[kind]]
        ]
    matrix = path.design.matrix
    coefficients = path.fit.coefficients
    variance = float(np.sum((path.design.means.rate.T.ravel() - matrix @ coefficients) ** 2)) / max(path.fit.dof, 1)
    inverse = path.fit.inverse[:3]
    sd, steady = math.sqrt(variance), variance * path.without_drift()
    return [
        _of_covariance("noise of the dwell means", sd, "rad/s", steady, gain),
        _of_covariance("drift of the bias", sd, "rad/s", variance * inverse @ inverse.T - steady, gain),
    ]


def _known_lines(path: Propagation, fix: Fix, known: Known, gain: Gains, declared: Declared) -> list[Contribution]:
    """Return what `estimate` itself took as known within a standard deviation."""
    drift_sd, correlation = known.acceleration_sensitive_drift_rate_sd, declared.scale_drift_correlation
    by_scale = gain.scale_factor * known.scale_factor_sd - correlation * drift_sd * gain.rates[:, 2]
    drift_alone_sd = drift_sd * math.sqrt(1.0 - correlation**2)
    leaning = np.add(fix.rates, [0.0, 0.0, known.acceleration_sensitive_drift_rate])
    lines = [
        _line("tilt", known.tilt_sd, "rad", "B", (known.tilt_sd * gain.rates @ by_tilt(leaning)).T),
        _line("scale factor", known.scale_factor_sd, "1", "B", [by_scale]),
        _line("acceleration-sensitive drift rate", drift_alone_sd, "rad/s/g", "B", [drift_alone_sd * gain.rates[:, 2]]),
        _line("latitude entry", known.latitude_sd, "rad", "B", [known.latitude_sd * gain.latitude]),
    ]
    if declared.ratio_sd:
        by_ratio = gain.rates[:, 2] * fix.rates[2] / declared.ratio
        lines.append(_line("ratio of the scale factors", declared.ratio_sd, "1", "B", [declared.ratio_sd * by_ratio]))
    if known.bias_sd is not None:
        lines.append(_line("bias", known.bias_sd, "rad/s", "B", (known.bias_sd * gain.rates @ path.by_known_bias()).T))
    if not path.vertical:
        sd = known.vertical_rate[1]
        lines.append(_line("vertical earth rate", sd, "rad/s", "B", [sd * gain.rates @ path.by_assumed_vertical()]))
    return lines


def _declared_lines(path: Propagation, fix: Fix, known: Known, gain: Gains, declared: Declared) -> list[Contribution]:
    """Return what is declared beside: stage angles, misalignment, the calibrated offset of the azimuth."""
    rates = fix.rates + np.array([0.0, 0.0, known.acceleration_sensitive_drift_rate])
    stage, misalignment = declared.stage_angle_sd, declared.misalignment_sd
    by_stage = stage * gain.rates @ path.by_stage_angles(rates) if stage else np.zeros((2, 0))
    each = declared.turn_sd / math.sqrt(2.0)  # of the two positions of a turn
    by_turn = each * gain.rates @ path.by_stage_angles(rates, ("azimuth",)) if each else np.zeros((2, 0))
    by_misalignment = misalignment * gain.rates @ path.by_misalignment(rates) if misalignment else np.zeros((2, 0))
    offset_sd = declared.azimuth_offset_sd
    if offset_sd is not None:  # the offset holds what a misalignment does to the azimuth
        by_misalignment = by_misalignment * np.array([[0.0], [1.0]])
    return [
        _line("stage angle", stage, "rad", "B", by_stage.T),
        *([_line("turn by hand", declared.turn_sd, "rad", "B", by_turn.T)] if each else []),
        _line("input axis misalignment", misalignment, "rad", "B", by_misalignment.T),
        _line("azimuth offset", offset_sd or 0.0, "rad", "B", [np.array([offset_sd or 0.0, 0.0])]),
    ]
