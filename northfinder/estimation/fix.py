"""What an estimate is given beside the data, and what it returns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from northfinder.estimation.checks import Check
from northfinder.estimation.quantiles import student_t
from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]

#: The scale factor is taken to lie this near 1 where it is not known and the earth's vertical rate must be assumed.
_SCALE_FACTOR_SD = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """What is known ahead of the measurement, each with its standard deviation; 0 means exactly.

    Raises ValueError for a value that is not finite, a negative standard deviation or a latitude beyond a pole.
    """

    latitude: float | None = None  #: rad; None to estimate it
    latitude_sd: float = 0.0
    scale_factor: float | None = None  #: output over input, 1 for an ideal gyro; None to estimate it
    scale_factor_sd: float = 0.0
    acceleration_sensitive_drift_rate: float = 0.0  #: rad/s per g along the input axis
    acceleration_sensitive_drift_rate_sd: float = 0.0
    tilt_sd: float = 0.0  #: rad, constant error of the measured tilt, either axis
    bias_sd: float | None = None  #: rad/s; each axis's bias is zero within it; None if nothing is known of them

    def __post_init__(self) -> None:
        """Check that every value can be one."""
        for name in self.__slots__:
            value = getattr(self, name)
            if value is None:
                continue
            if not math.isfinite(value) or (name.endswith("_sd") and value < 0.0):
                raise ValueError(f"{name} must be a finite number, and not negative for a standard deviation: {value}")
        if self.latitude is not None and abs(self.latitude) > math.pi / 2.0:
            raise ValueError(f"latitude must lie between -pi/2 and pi/2 rad, not {self.latitude}")
        if self.scale_factor is not None and self.scale_factor <= 0.0:
            raise ValueError(f"scale_factor must be positive, not {self.scale_factor}")

    @property
    def vertical_rate(self) -> tuple[float, float]:
        """What may be assumed of V, rad/s, where it is not measured, and its standard deviation.

        It matters only through the tilt.
        """
        if self.latitude is None:  # every direction of the earth's axis alike: V is uniform within the earth rate
            return self.acceleration_sensitive_drift_rate, EARTH_RATE / math.sqrt(3.0)
        scale = 1.0 if self.scale_factor is None else self.scale_factor
        scale_sd = _SCALE_FACTOR_SD if self.scale_factor is None else self.scale_factor_sd
        spread = (scale * math.cos(self.latitude) * self.latitude_sd, math.sin(self.latitude) * scale_sd)
        sd = math.hypot(EARTH_RATE * spread[0], EARTH_RATE * spread[1], self.acceleration_sensitive_drift_rate_sd)
        return scale * EARTH_RATE * math.sin(self.latitude) + self.acceleration_sensitive_drift_rate, sd


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fix:
    """Azimuth and latitude with their standard deviations, and what speaks for or against them."""

    azimuth: float  #: rad, true azimuth of stage azimuth zero, in [0, 2 pi)
    azimuth_sd: float  #: rad
    latitude: float | None  #: rad, north positive; None if the data do not determine it, see `latitude_reason`
    latitude_sd: float | None  #: rad
    latitude_reason: str  #: why there is no latitude, empty if there is one
    scale_factor: float | None  #: output over input; None if the data do not determine it
    scale_factor_sd: float | None
    bias: tuple[float, ...]  #: rad/s, of each axis: the mean over the data
    bias_sd: tuple[float, ...]
    drift_rate: tuple[float, ...]  #: rad/s^2, slope of the bias of each axis; empty unless the model is linear
    drift_rate_sd: tuple[float, ...]
    rates: Array  #: (3,) N, E, V in rad/s, the acceleration-sensitive drift removed
    rates_covariance: Array  #: (3, 3)
    residuals: Array  #: (n, n_axes) rad/s, measured less modelled
    n_means: int
    dof: int  #: degrees of freedom of the residuals
    normalised_residual: float | None  #: chi2/dof of the whitened residuals; None without a noise model
    rescaled_by: float  #: factor put on the noise's standard deviations because the residuals demanded it; else 1
    sd_dof: float  #: degrees of freedom behind the standard deviations; infinite with a noise model that fits
    n_rejected: int  #: means left out as disturbed
    checks: tuple[Check, ...]

    @property
    def trustworthy(self) -> bool:
        """Whether every decisive check passed."""
        return all(check.passed or not check.decisive for check in self.checks)

    def coverage_factor(self, probability: float = 0.95) -> float:
        """Return how many standard deviations on either side hold the truth with `probability` (Student t)."""
        return student_t(0.5 - probability / 2.0, self.sd_dof)
