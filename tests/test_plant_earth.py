"""The earth's rotation reaches the input axes as the convention sheet says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_device.plant.earth import (
    EARTH_RATE,
    Site,
    input_axes,
    matrix_about_y,
    matrix_about_z,
    matrix_from_rotation_vector,
    pedestal_attitude,
    plate_attitude,
    project,
)

X_AXIS = input_axes(1, [[0.0, 0.0, 0.0]])
LEVEL_KYIV = Site(latitude=math.radians(50.429), heading=0.0)


def rate_dph(site: Site, azimuth_deg: float, elevation_deg: float) -> float:
    """Return the rate about the input axis in deg/h."""
    seen = project(site, X_AXIS, math.radians(azimuth_deg), math.radians(elevation_deg))
    return float(np.degrees(seen.rate[0, 0]) * 3600)


@pytest.mark.parametrize(
    ("latitude_deg", "heading_deg", "azimuth_deg", "elevation_deg", "expected_dph"),
    [
        (0.0, 0.0, 0.0, 0.0, 15.0411),  # equator, north
        (0.0, 0.0, 180.0, 0.0, -15.0411),
        (0.0, 0.0, 90.0, 0.0, 0.0),
        (90.0, 0.0, 123.0, 90.0, 15.0411),  # north pole, up
        (-90.0, 0.0, 0.0, 90.0, -15.0411),  # south pole, up
        (60.0, 0.0, 60.0, 0.0, 3.7603),  # 15.0411 * cos 60 * cos 60
        (60.0, 60.0, 0.0, 0.0, 3.7603),  # the same by the heading
        (60.0, 100.0, 20.0, 0.0, -3.7603),  # true azimuth 120
        (30.0, 0.0, 0.0, 30.0, 15.0411),  # along the earth's axis: cos 30 cos 30 + sin 30 sin 30 = 1
        (-30.0, 0.0, 0.0, 30.0, 7.5205),  # southern: cos 30 cos 30 - sin 30 sin 30 = 1/2
        (50.429, 0.0, 270.0, -90.0, -11.5942),  # down: -15.0411 * 0.77084
    ],
)
def test_rate_at_checked_attitudes(
    latitude_deg: float, heading_deg: float, azimuth_deg: float, elevation_deg: float, expected_dph: float
) -> None:
    """Rates calculated by hand come out, in all quadrants and both hemispheres."""
    site = Site(latitude=math.radians(latitude_deg), heading=math.radians(heading_deg))
    assert rate_dph(site, azimuth_deg, elevation_deg) == pytest.approx(expected_dph, abs=2e-3)


def test_matrices_are_scipys() -> None:
    """Elementary turns and rotation vectors agree with scipy's Rotation."""
    angle = np.array([-3.0, -0.2, 0.0, 1.1])
    assert np.allclose(matrix_about_z(angle), Rotation.from_euler("z", angle[:, None]).as_matrix(), atol=1e-15)
    assert np.allclose(matrix_about_y(angle), Rotation.from_euler("y", angle[:, None]).as_matrix(), atol=1e-15)
    vector = [0.3, -0.2, 0.9]
    assert np.allclose(matrix_from_rotation_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    assert np.array_equal(matrix_from_rotation_vector([0.0, 0.0, 0.0]), np.eye(3))


def test_whole_chain_is_scipys() -> None:
    """Tilt, heading, stage and misalignment compose in the order of the convention sheet."""
    rng = np.random.default_rng(7)
    site = Site(latitude=-0.6, heading=2.5, tilt=(0.02, -0.03))
    azimuth, elevation = rng.uniform(-7, 7, 50), rng.uniform(-1.6, 1.6, 50)
    axes = input_axes(3, [[0.001, 0.002, -0.003], [0.002, 0.0, 0.001], [-0.001, 0.003, 0.0]])
    vec_n = EARTH_RATE * np.array([math.cos(-0.6), 0.0, -math.sin(-0.6)])
    to_n = (
        Rotation.from_euler("z", 2.5)
        * Rotation.from_rotvec([-0.03, -0.02, 0.0])
        * (Rotation.from_euler("z", azimuth[:, None]) * Rotation.from_euler("y", elevation[:, None]))
    )
    expected = np.stack([to_n.apply(axis) @ vec_n for axis in axes], -1)
    assert np.allclose(project(site, axes, azimuth, elevation).rate, expected, rtol=0, atol=1e-19)


def test_tilt_leans_the_axis_where_it_says() -> None:
    """A positive tilt_x leans the rotation axis' upper end toward stage zero, tilt_y toward stage 90 deg."""
    heading = math.radians(90)  # stage zero points east
    up = pedestal_attitude(Site(latitude=0.0, heading=heading, tilt=(0.01, 0.0))) @ [0.0, 0.0, -1.0]
    assert up == pytest.approx([0.0, 0.01, -1.0], abs=1e-4)  # leans east
    up = pedestal_attitude(Site(latitude=0.0, heading=heading, tilt=(0.0, 0.01))) @ [0.0, 0.0, -1.0]
    assert up == pytest.approx([-0.01, 0.0, -1.0], abs=1e-4)  # stage 90 points south


def test_east_tilt_shifts_azimuth_by_tan_latitude() -> None:
    """A tilt t toward east shifts where the horizontal rate is greatest by t tan lat (method, section 5)."""
    tilt = 1e-4
    site = Site(latitude=math.radians(60), heading=0.0, tilt=(0.0, tilt))
    azimuth = np.radians([0.0, 90.0, 180.0, 270.0])
    u1, u2, u3, u4 = project(site, X_AXIS, azimuth, np.zeros(4)).rate[:, 0]
    assert math.atan2(u4 - u2, u1 - u3) == pytest.approx(tilt * math.tan(math.radians(60)), rel=1e-3)


def test_input_axis_and_up_component() -> None:
    """The x axis at elevation e has the upward component sin e, level sheet or not; its misalignment adds."""
    for elevation_deg, lift_arcsec in [(0.0, 0.0), (90.0, 0.0), (-90.0, 0.0), (30.0, 3600.0)]:
        axes = input_axes(1, [[0.0, math.radians(lift_arcsec / 3600), 0.0]])
        seen = project(LEVEL_KYIV, axes, 1.0, math.radians(elevation_deg))
        assert seen.up[0, 0] == pytest.approx(math.sin(math.radians(elevation_deg + lift_arcsec / 3600)), abs=1e-12)
    assert plate_attitude(0.4, 0.2)[:, 0] == pytest.approx(
        [math.cos(0.2) * math.cos(0.4), math.cos(0.2) * math.sin(0.4), -math.sin(0.2)]
    )


def test_stage_rotation_is_seen() -> None:
    """A stage turning in azimuth is seen in full by an axis pointing down, in elevation by the y axis."""
    axes = input_axes(3, np.zeros((3, 3)))
    still = project(LEVEL_KYIV, axes, 0.3, math.radians(-90)).rate[0]
    turning = project(LEVEL_KYIV, axes, 0.3, math.radians(-90), azimuth_rate=0.2, elevation_rate=0.05).rate[0]
    assert turning - still == pytest.approx([0.2, 0.05, 0.0], abs=1e-15)
