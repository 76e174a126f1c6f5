"""The direction of the input axis, against rotations that SciPy composes."""

import numpy as np
from scipy.spatial.transform import Rotation

from northfinder.estimation.geometry import sensitivity


def test_attitude_agrees_with_composed_rotations() -> None:
    """Any attitude of the stage on a pedestal tilted by up to 20 deg, one axis and three; and no tilt at all."""
    rng = np.random.default_rng(1)
    azimuth, elevation = rng.uniform(-7.0, 7.0, 200), rng.uniform(-1.6, 1.6, 200)
    tilt = rng.normal(0.0, 0.1, (200, 2))
    tilt[0] = 0.0
    head = Rotation.from_euler("ZY", np.column_stack([azimuth, elevation]))
    lean = Rotation.from_rotvec(np.column_stack([tilt[:, 1], -tilt[:, 0], np.zeros(200)]))
    expected = np.swapaxes((lean * head).as_matrix(), 1, 2) * [1.0, -1.0, -1.0]
    assert np.abs(sensitivity(azimuth, elevation, tilt, n_axes=3) - expected).max() < 1e-14
    assert np.abs(sensitivity(azimuth, elevation, tilt) - expected[:, :1]).max() < 1e-14


def test_lean_toward_an_azimuth() -> None:
    """A pedestal that leans by 1e-3 toward stage azimuth zero dips an input axis that points there, and only that."""
    rows = sensitivity([0.0, np.pi / 2], [0.0, 0.0], [[1e-3, 0.0], [1e-3, 0.0]])[:, 0]
    assert np.allclose(rows[0], [np.cos(1e-3), 0.0, -np.sin(1e-3)])
    assert np.allclose(rows[1], [0.0, -1.0, 0.0])
