"""Rotations agree however they are said."""

from __future__ import annotations

import numpy as np
import pytest

from envs.cameras import euler_rotations, yaw_rotations


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_yaw_rotations_are_euler_rotations_about_z_alone(shape: tuple[int, ...]) -> None:
    yaw_rad = np.random.default_rng(0).uniform(-4.0, 4.0, shape)
    angles = np.stack([0.0 * yaw_rad, 0.0 * yaw_rad, yaw_rad], axis=-1)
    expected = euler_rotations(angles.reshape(-1, 3)).reshape(*shape, 3, 3)
    found = yaw_rotations(yaw_rad)
    assert found.shape == (*shape, 3, 3)
    np.testing.assert_allclose(found, expected, atol=1e-15)
