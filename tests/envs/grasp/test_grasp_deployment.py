"""What the grasp task declares is what its simulation does."""

from __future__ import annotations

import numpy as np

from envs.grasp.deployment import deployment
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import heading
from envs.grasp.sensors.camera import sample_views
from envs.grasp.settings import Camera, GraspSettings
from envs.grasp.vector_env import GraspVectorEnv

SETTINGS = GraspSettings(
    num_envs=1,
    cameras={"near": Camera(type="depth", roll_deg=45.0), "above": Camera(type="rgb")},
)


def test_actions_mean_the_poses_that_the_arm_goes_to() -> None:
    meaning = GraspVectorEnv.deployment(SETTINGS).meaning
    assert meaning is not None
    assert [quantity.name for quantity in meaning.quantities] == ["x_m", "y_m", "z_m", "yaw_rad"]
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 4))
    tooltip_m, yaw_rad = Arm.of(SETTINGS, load_robot()).pose(actions)
    low, high = np.array([(one.low, one.high) for one in meaning.quantities]).T
    told = low + (actions + 1.0) / 2.0 * (high - low)
    np.testing.assert_allclose(told, np.column_stack([tooltip_m, yaw_rad]), atol=1e-12)


def test_cameras_are_mounted_where_they_are_when_nothing_is_drawn() -> None:
    mounts = deployment(SETTINGS).mounts
    assert set(mounts) == set(SETTINGS.cameras)
    for name, camera in SETTINGS.cameras.items():
        still = sample_views(camera, np.random.default_rng(0), 1, position_m=0.0, rotation_deg=0.0)
        np.testing.assert_allclose(mounts[name].position_m, still.position_m[0])
        np.testing.assert_allclose(mounts[name].rotation, still.rotation[0], atol=1e-12)


def test_the_outline_is_the_cup_before_its_stem() -> None:
    meaning = deployment(SETTINGS).meaning
    assert meaning is not None
    place = np.array([1.0, 0.2, 0.8, 0.3])
    rim, stem = meaning.lines(place)
    ahead = heading(np.array(0.3))
    np.testing.assert_allclose((rim - place[:3]) @ ahead, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(rim - place[:3], axis=1), 0.03)
    np.testing.assert_allclose(stem, [place[:3], place[:3] - 0.08 * ahead])
