"""What the simulators' tests have in common: robots, scenes and cameras."""

from __future__ import annotations

import numpy as np

from envs.grasp.robot.kinematics import InverseKinematics
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import Scenes, SceneSampler
from envs.grasp.sensors.camera import CameraPoses, sample_views
from envs.grasp.settings import Camera, GraspSettings

ROBOT = load_robot()
INVERSE = InverseKinematics(ROBOT)
HOME = ROBOT.home_rad
FIRST = np.array([0])
RESOLUTION_M = GraspSettings().contact_resolution_m


def home(count: int) -> np.ndarray:
    return np.tile(HOME, (count, 1))


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    """Joint angles (1, 1, 6): a path of one pose."""
    joints, reached = INVERSE(np.array([[x, y, z]]), np.array([yaw]))
    assert reached.all()
    return joints[:, None]


def fixed_views(camera: Camera, count: int = 1) -> CameraPoses:
    return sample_views(camera, np.random.default_rng(0), count, 0.0, 0.0)


def sampled(count: int, seed: int = 0, **cameras: Camera) -> tuple[Scenes, dict[str, CameraPoses]]:
    settings = GraspSettings(cameras=cameras or {"depth": Camera(type="depth")})
    return SceneSampler(settings).sample(np.random.default_rng(seed), np.full(count, np.pi))


def reaching(scenes: Scenes, seed: int = 0) -> np.ndarray:
    """Paths (n, 5, 6) that end near the targets, so that some touch and some collide."""
    rng = np.random.default_rng(seed)
    tooltip = scenes.target_m + rng.uniform(-0.06, 0.06, scenes.target_m.shape)
    joints, _ = INVERSE(tooltip, scenes.target_yaw_rad)
    part = np.linspace(0.2, 1.0, 5)[None, :, None]
    return HOME * (1 - part) + joints[:, None] * part
