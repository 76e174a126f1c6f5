"""The earth's rotation and the vertical, as the input axes of a gyro on a tilted two-axis stage meet them.

Frames (convention sheet in ``northfinder``): ``n`` north, east, down; ``p`` pedestal; ``s`` the plate that carries the
gyro, whose axes at stage azimuth and elevation zero are those of ``p``. The plate is turned from ``p`` by the azimuth
about the z axis (down), then by the elevation about its own y axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

EARTH_RATE = 7.292115e-5  #: rad/s, the earth's rotation against inertial space

Vector = NDArray[np.float64]  #: shape (3,) or (n, 3)
Matrix = NDArray[np.float64]  #: shape (3, 3) or (n, 3, 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Where the pedestal stands, and how."""

    latitude: float  #: rad, north positive
    heading: float  #: rad, true azimuth of stage azimuth zero
    tilt: tuple[float, float] = (0.0, 0.0)  #: rad, lean of the rotation axis toward stage azimuth 0 and 90 deg


def matrix_about_z(angle: ArrayLike) -> Matrix:
    """Return the matrix that turns vectors by `angle` (rad) about z, shape of `angle` + (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, one], -1)], -2)


def matrix_about_y(angle: ArrayLike) -> Matrix:
    """Return the matrix that turns vectors by `angle` (rad) about y, shape of `angle` + (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([np.stack([c, zero, s], -1), np.stack([zero, one, zero], -1), np.stack([-s, zero, c], -1)], -2)


def matrix_from_rotation_vector(vector: ArrayLike) -> Matrix:
    """Return the matrix of a rotation vector (rad), by Rodrigues' formula."""
    vec = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(vec))
    if angle == 0:
        return np.eye(3)
    x, y, z = vec / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: Matrix = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return turn


@lru_cache(maxsize=16)
def pedestal_attitude(site: Site) -> Matrix:
    """Return mat_np: the tilt in the pedestal's own axes, then the heading about the vertical. Not to be written to."""
    tilt_x, tilt_y = site.tilt
    mat: Matrix = matrix_about_z(site.heading) @ matrix_from_rotation_vector((tilt_y, -tilt_x, 0.0))
    mat.flags.writeable = False
    return mat


def plate_attitude(azimuth: ArrayLike, elevation: ArrayLike) -> Matrix:
    """Return mat_ps for stage angles in rad, shape (n, 3, 3)."""
    return matrix_about_z(azimuth) @ matrix_about_y(elevation)


def input_axes(n_axes: int, misalignment: ArrayLike) -> Vector:
    """Return the input axes in s, shape (n_axes, 3): x, y, z of the plate, each turned by its misalignment.

    Parameters
    ----------
    n_axes
        1 or 3.
    misalignment
        Rotation vector of each axis in s, rad, shape (n_axes, 3).

    """
    turns = np.asarray(misalignment, dtype=np.float64).reshape(n_axes, 3)
    return np.stack([matrix_from_rotation_vector(turns[i]) @ np.eye(3)[i] for i in range(n_axes)])


@dataclass(frozen=True, slots=True)
class Projection:
    """What the input axes meet, each shape (n, n_axes)."""

    rate: Vector  #: rad/s, rotation against inertial space
    up: Vector  #: upward component of the unit input axis, which is the specific force along it in g


def project(
    site: Site,
    axes: Vector,
    azimuth: ArrayLike,
    elevation: ArrayLike,
    *,
    azimuth_rate: ArrayLike = 0.0,
    elevation_rate: ArrayLike = 0.0,
) -> Projection:
    """Project the earth's and the stage's rotation, and the vertical, onto the input axes.

    Parameters
    ----------
    site
        Place and attitude of the pedestal.
    axes
        Input axes in s, shape (n_axes, 3), see `input_axes`.
    azimuth, elevation
        Stage angles, rad, shape (n,).
    azimuth_rate, elevation_rate
        Rotation of the stage itself, rad/s, shape (n,) or a scalar.

    Returns
    -------
    Projection
        Shape (n, n_axes).

    """
    azimuth, elevation = np.broadcast_arrays(np.atleast_1d(azimuth), np.atleast_1d(elevation))
    mat_np = pedestal_attitude(site)
    vec_n_earth = EARTH_RATE * np.array([math.cos(site.latitude), 0.0, -math.sin(site.latitude)])
    vec_p_stage = np.multiply.outer(np.broadcast_to(azimuth_rate, azimuth.shape), [0.0, 0.0, 1.0])
    vec_s_stage = np.multiply.outer(np.broadcast_to(elevation_rate, azimuth.shape), [0.0, 1.0, 0.0])
    mat_ps = plate_attitude(azimuth, elevation)
    rate_s = np.einsum("nji,nj->ni", mat_ps, mat_np.T @ vec_n_earth + vec_p_stage) + vec_s_stage
    up_s = np.einsum("nji,j->ni", mat_ps, mat_np.T @ np.array([0.0, 0.0, -1.0]))
    return Projection(rate_s @ axes.T, up_s @ axes.T)
