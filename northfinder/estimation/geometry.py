"""Direction of the input axis in a level frame, and the way from the rates N, E, V to angles and back."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from northfinder.units import EARTH_RATE

Array = NDArray[np.float64]

#: Level frame (stage azimuth 0, stage azimuth 90 deg, down) to the directions that N, E and V are measured along.
_TO_NEV = np.array([1.0, -1.0, -1.0])


def sensitivity(azimuth: ArrayLike, elevation: ArrayLike, tilt: ArrayLike, *, n_axes: int = 1) -> Array:
    """Return how strongly each input axis feels N, E and V at the measured attitudes.

    ``N = K cos lat cos A``, ``E = K cos lat sin A``, ``V = K sin lat`` with the azimuth ``A`` of stage azimuth zero and
    ``K`` the scale factor times the earth rate. Without tilt a row is ``(cos e cos a, -cos e sin a, sin e)``: with
    ``A`` the azimuth of stage zero, the rate is ``K (cos lat cos e cos(A + a) + sin lat sin e)`` (docs/method.md,
    section 1). The tilt turns the pedestal by the rotation vector ``(tilt_y, -tilt_x, 0)``.

    Parameters
    ----------
    azimuth, elevation : (n,) arrays
        Stage angles, rad.
    tilt : (n, 2) array
        Tilt of the pedestal, rad.
    n_axes : int
        1 for the forward axis alone, 3 for the axes forward, right and down of the stage's head.

    Returns
    -------
    (n, n_axes, 3) array
    """
    azimuth, elevation, tilt = (np.asarray(angle, dtype=np.float64) for angle in (azimuth, elevation, tilt))
    axes = head_axes(azimuth, elevation)[:, :n_axes]
    lean = np.column_stack([tilt[:, 1], -tilt[:, 0], np.zeros(len(tilt))])
    return np.asarray(_turned(axes, lean) * _TO_NEV)


def head_axes(azimuth: Array, elevation: Array) -> Array:
    """Return the axes forward, right and down of the stage's head in pedestal axes, shape (n, 3 axes, 3)."""
    sin_a, cos_a, sin_e, cos_e = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    forward = np.column_stack([cos_e * cos_a, cos_e * sin_a, -sin_e])
    right = np.column_stack([-sin_a, cos_a, np.zeros(azimuth.size)])
    return np.stack([forward, right, np.cross(forward, right)], axis=1)


def _turned(axes: Array, rotation: Array) -> Array:
    """Return `axes`, (n, n_axes, 3), turned by the rotation vectors, (n, 3): Rodrigues' formula."""
    angle = np.linalg.norm(rotation, axis=1)[:, np.newaxis, np.newaxis]
    vector = rotation[:, np.newaxis, :]
    across = np.cross(vector, axes)
    # np.sinc(x) is sin(pi x)/(pi x), so both factors are right for no rotation at all.
    sine, versine = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(axes + sine * across + versine * np.cross(vector, across))


def rates(azimuth: float, latitude: float, scale_factor: float = 1.0) -> Array:
    """Return (N, E, V) in rad/s for the azimuth of stage zero and the latitude, rad."""
    horizontal = math.cos(latitude)
    unit = [horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(latitude)]
    return scale_factor * EARTH_RATE * np.array(unit)


def angles(nev: Array) -> Array:
    """Return (azimuth, latitude, scale factor) of the rates (N, E, V), the azimuth in [0, 2 pi)."""
    north, east, vertical = (float(x) for x in nev)
    horizontal = math.hypot(north, east)
    azimuth = wrapped(math.atan2(east, north))
    return np.array([azimuth, math.atan2(vertical, horizontal), math.hypot(horizontal, vertical) / EARTH_RATE])


def wrapped(azimuth: float) -> float:
    """Return an azimuth in [0, 2 pi), also where rounding a tiny negative one would give 2 pi."""
    turned = azimuth % (2.0 * math.pi)
    return turned if turned < 2.0 * math.pi else 0.0


def by_tilt(rates: Array) -> Array:
    """Return what one radian of tilt toward stage azimuth 0 and 90 deg makes of N, E and V, shape (3, 2)."""
    north, east, vertical = rates
    return np.array([[-vertical, 0.0], [0.0, vertical], [north, -east]])


def rates_jacobian(azimuth: float, latitude: float, scale_factor: float = 1.0) -> Array:
    """Return the derivative of `rates` by (azimuth, latitude, scale factor), shape (3, 3)."""
    sin_a, cos_a = math.sin(azimuth), math.cos(azimuth)
    sin_l, cos_l = math.sin(latitude), math.cos(latitude)
    by_azimuth = scale_factor * np.array([-cos_l * sin_a, cos_l * cos_a, 0.0])
    by_latitude = scale_factor * np.array([-sin_l * cos_a, -sin_l * sin_a, cos_l])
    by_scale = np.array([cos_l * cos_a, cos_l * sin_a, sin_l])
    return EARTH_RATE * np.column_stack([by_azimuth, by_latitude, by_scale])
