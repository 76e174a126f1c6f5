"""First-order errors of a triad that gyrocompasses at rest, in one position or in two (docs/method.md, section 5).

Formulas (5) to (16) of [S1]; what is not printed there was derived again from (1), (3) and (4). Body axes x forward,
y up, z right; roll right side down, pitch nose up, azimuth of x clockwise from true north. All in SI and radians. An
error is what is measured less what is true.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]

GRAVITY = 9.80665  #: m/s^2


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """How the body lies and where it is."""

    azimuth: float  #: rad
    pitch: float = 0.0  #: rad
    roll: float = 0.0  #: rad
    latitude: float = 0.0  #: rad

    @property
    def up(self) -> Array:
        """Upward direction in body axes, (1): what ideal accelerometers read, in g, shape (3,)."""
        cos_pitch = math.cos(self.pitch)
        return np.array([math.sin(self.pitch), cos_pitch * math.cos(self.roll), -cos_pitch * math.sin(self.roll)])

    @property
    def north(self) -> Array:
        """Northward direction in body axes, (1), shape (3,)."""
        sin_a, cos_a = math.sin(self.azimuth), math.cos(self.azimuth)
        sin_roll, cos_roll = math.sin(self.roll), math.cos(self.roll)
        up = -math.sin(self.pitch) * cos_a  # of y before the roll
        return np.array(
            [math.cos(self.pitch) * cos_a, up * cos_roll - sin_a * sin_roll, -sin_a * cos_roll - up * sin_roll]
        )

    @property
    def rate(self) -> Array:
        """Earth rate in body axes, (1), rad/s, shape (3,)."""
        return EARTH_RATE * (math.cos(self.latitude) * self.north + math.sin(self.latitude) * self.up)


def sensor_error(
    true: ArrayLike, *, scale_factor_error: ArrayLike = 0.0, zero_shift: ArrayLike = 0.0, noise: ArrayLike = 0.0
) -> Array:
    """Return the errors of three sensors that should read `true`, by (5), shape (3,)."""
    scale, shift, random = (np.asarray(part, dtype=np.float64) for part in (scale_factor_error, zero_shift, noise))
    return np.asarray(scale * np.asarray(true, dtype=np.float64) + shift + random)


def levelling_jacobian(attitude: Attitude) -> Array:
    """Return how roll and pitch follow the errors of the accelerometers, (8), 1/(m/s^2), shape (2, 3)."""
    sin_p, cos_p = math.sin(attitude.pitch), math.cos(attitude.pitch)
    sin_r, cos_r = math.sin(attitude.roll), math.cos(attitude.roll)
    return np.array([[0.0, -sin_r / cos_p, -cos_r / cos_p], [cos_p, -sin_p * cos_r, sin_p * sin_r]]) / GRAVITY


def levelling_errors(attitude: Attitude, accelerometer_error: ArrayLike) -> Array:
    """Return the errors of (roll, pitch) by (8), rad, from those of the accelerometers, m/s^2, shape (3,)."""
    return np.asarray(levelling_jacobian(attitude) @ np.asarray(accelerometer_error, dtype=np.float64))


def worst_levelling_errors(attitude: Attitude, *, scale_factor_error: float, zero_shift: float, noise: float) -> Array:
    """Return the largest errors of (roll, pitch) by (8), rad: each error with the worst sign on each accelerometer."""
    jacobian = np.abs(levelling_jacobian(attitude))
    error = scale_factor_error * GRAVITY * np.abs(attitude.up) + zero_shift + noise
    return np.asarray(jacobian @ error)


def latitude_error(attitude: Attitude, gyro_error: ArrayLike, levelling: ArrayLike = (0.0, 0.0)) -> float:
    """Return the error of the latitude from (4), by (9), rad.

    Parameters
    ----------
    attitude : Attitude
    gyro_error : (3,) array
        rad/s.
    levelling : (2,) array
        Errors of (roll, pitch), rad.
    """
    sin_p, cos_p = math.sin(attitude.pitch), math.cos(attitude.pitch)
    sin_r, cos_r = math.sin(attitude.roll), math.cos(attitude.roll)
    by_roll, by_pitch = (
        np.array([0.0, -cos_p * sin_r, -cos_p * cos_r]),
        np.array([cos_p, -sin_p * cos_r, sin_p * sin_r]),
    )
    roll, pitch = np.asarray(levelling)
    error = attitude.up @ np.asarray(gyro_error) + attitude.rate @ (by_roll * roll + by_pitch * pitch)
    return float(error) / (EARTH_RATE * math.cos(attitude.latitude))


def azimuth_error(attitude: Attitude, gyro_x_error: float, *, latitude: float = 0.0, pitch: float = 0.0) -> float:
    """Return the error of the azimuth found from the x gyro by (3), by (10), rad.

    It is least with x pointing east or west, and without bound with x in the meridian.

    Parameters
    ----------
    attitude : Attitude
    gyro_x_error : float
        rad/s.
    latitude, pitch : float
        Errors of the latitude and the pitch that (3) takes, rad.
    """
    sin_p, cos_p = math.sin(attitude.pitch), math.cos(attitude.pitch)
    sin_l, cos_l = math.sin(attitude.latitude), math.cos(attitude.latitude)
    cos_a = math.cos(attitude.azimuth)
    by_latitude = cos_a * sin_l * cos_p - cos_l * sin_p
    by_pitch = cos_a * cos_l * sin_p - sin_l * cos_p
    error = gyro_x_error / EARTH_RATE + by_latitude * latitude + by_pitch * pitch
    return -error / (math.sin(attitude.azimuth) * cos_l * cos_p)


def turned(vector: ArrayLike, turn: float) -> Array:
    """Return a vector in body axes after the body has turned by `turn`, rad, about its y axis; (11) and (12)."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    sin_t, cos_t = math.sin(turn), math.cos(turn)
    return np.array([x * cos_t - z * sin_t, y, z * cos_t + x * sin_t])


def double_sensor_error(
    true: ArrayLike, *, scale_factor_error: ArrayLike = 0.0, zero_shift: ArrayLike = 0.0, turn_error: float = 0.0
) -> Array:
    """Return the errors of half differences (of y: half sums) of two positions turned by 180 deg about y, shape (3,).

    The zero shifts of x and z cancel; what remains is the mean error `turn_error`, rad, of the two turn angles.
    """
    x, y, z = np.asarray(true, dtype=np.float64)
    shift = np.broadcast_to(np.asarray(zero_shift, dtype=np.float64), (3,)) * np.array([0.0, 1.0, 0.0])
    by_turn = turn_error * np.array([-z, 0.0, x])
    return sensor_error((x, y, z), scale_factor_error=scale_factor_error, zero_shift=shift, noise=by_turn)


def double_levelling_errors(
    attitude: Attitude, *, scale_factor_error: ArrayLike = 0.0, zero_shift: ArrayLike = 0.0, turn_error: float = 0.0
) -> Array:
    """Return the errors of (roll, pitch) from two positions, by (13), rad."""
    error = double_sensor_error(
        GRAVITY * attitude.up, scale_factor_error=scale_factor_error, zero_shift=zero_shift, turn_error=turn_error
    )
    return levelling_errors(attitude, error)


def double_azimuth_error(attitude: Attitude, *, scale_factor_error: float = 0.0, turn_error: float = 0.0) -> float:
    """Return the error of the azimuth from two positions, by (15), rad; levelling errors add as in (10)."""
    error = double_sensor_error(attitude.rate, scale_factor_error=scale_factor_error, turn_error=turn_error)
    return azimuth_error(attitude, float(error[0]))


def levelling_turn_limit(accelerometer_zero_shift: float) -> float:
    """Return the turn error, rad, far below which turning helps the levelling, by (14)."""
    return math.asin(accelerometer_zero_shift / GRAVITY)


def azimuth_turn_limit(attitude: Attitude, gyro_zero_shift: float) -> float:
    """Return the turn error, rad, far below which turning helps the azimuth, by (16)."""
    return abs(gyro_zero_shift / float(attitude.rate[2]))
