"""Observations of the grasp environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from encoders.spaces import DepthImage, RgbImage
from envs.grasp.episode_state import RunningEpisodes
from envs.grasp.sensors.camera import CameraPoses, image_space
from envs.grasp.sensors.clouds import CloudCamera, cloud_camera
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.base import Simulator

PRIVILEGED = "privileged"
POSES_AND_PROGRESS, LIMITS = 18, 4
# Brings the privileged numbers near 1: positions are decimetres off the workspace's middle.
WORKSPACE_MIDDLE_M = np.array([1.05, 0.0, 0.75])
DECIMETRES_PER_M = 10.0


def observation_space(settings: GraspSettings) -> gymnasium.spaces.Dict:
    """The space of one environment's observations."""
    spaces: dict[str, gymnasium.Space[Any]] = {
        name: CloudCamera(camera).space if camera.type == "points" else image_space(camera)
        for name, camera in settings.cameras.items()
    }
    if settings.privileged:
        size = POSES_AND_PROGRESS + (LIMITS if settings.privileged_limits else 0)
        spaces[PRIVILEGED] = Box(-np.inf, np.inf, (size,), np.float32)
    return gymnasium.spaces.Dict(spaces)


def image_spaces(settings: GraspSettings) -> dict[str, DepthImage | RgbImage]:
    """The spaces of the cameras' images, by their names: of clouds, those they are made of."""
    return {name: image_space(camera) for name, camera in settings.cameras.items()}


def take_images(
    simulator: Simulator,
    indices: NDArray[np.int64],
    views: Mapping[str, CameraPoses],
    spaces: Mapping[str, gymnasium.Space[Any]],
    rng: np.random.Generator,
) -> dict[str, NDArray[Any]]:
    """Images (n, H, W, C) as cameras' sensors deliver them now, by their names.

    Args:
        simulator: holds the worlds.
        indices: of the n worlds.
        views: the cameras.
        spaces: of their images; see `image_spaces`.
        rng: the source of the sensors' randomness.
    """
    images: dict[str, NDArray[Any]] = {}
    for name, view in views.items():
        space = spaces[name]
        if isinstance(space, DepthImage):
            seeds = picture_seeds(rng, len(indices))
            images[name] = simulator.render_depth(indices, view, space, seeds)
        else:
            images[name] = simulator.render(indices, view)
    return images


def observed(
    images: Mapping[str, NDArray[Any]],
    views: Mapping[str, CameraPoses],
    rng: np.random.Generator,
) -> dict[str, NDArray[Any]]:
    """What is observed of n images each: themselves, or clouds (n, P, 4), by the cameras' names.

    Args:
        images: (n, H, W, C) as the sensors deliver them.
        views: the cameras.
        rng: the source of the clouds' randomness.
    """
    clouds = {
        name: cloud_camera(view.camera).clouds(images[name], picture_seeds(rng, len(view)))
        for name, view in views.items()
        if view.camera.type == "points"
    }
    return {**images, **clouds}


def picture_seeds(rng: np.random.Generator, count: int) -> NDArray[np.uint64]:
    """Seeds (count,) of all that is random in as many pictures."""
    return rng.integers(2**63, size=count, dtype=np.uint64)


def privileged_state(episodes: RunningEpisodes, settings: GraspSettings) -> NDArray[np.float32]:
    """True state (N, 22 or 18): tool and target pose, goal limits if set so, progress."""
    scenes, tools, region = episodes.scenes, episodes.tools, episodes.region
    progress, yaw = episodes.progress, episodes.scenes.target_yaw_rad
    limits = [
        region.lateral_limit_m * DECIMETRES_PER_M,
        region.vertical_limit_m * DECIMETRES_PER_M,
        region.gap_limit_m * DECIMETRES_PER_M,
        np.radians(region.yaw_limit_deg) * DECIMETRES_PER_M,
    ]
    columns = [
        (tools.tooltip_m - WORKSPACE_MIDDLE_M) * DECIMETRES_PER_M,
        np.sin(tools.yaw_rad),
        tools.axis[:, 2],
        (scenes.target_m - WORKSPACE_MIDDLE_M) * DECIMETRES_PER_M,
        np.sin(yaw),
        (tools.tooltip_m - scenes.target_m) * DECIMETRES_PER_M,
        np.sin(tools.yaw_rad - yaw),
        *(limits if settings.privileged_limits else ()),
        progress.steps / settings.episode_steps,
        progress.steps == 0,
        progress.touched,
        progress.position_right,
        progress.rotation_right,
    ]
    return np.column_stack(columns).astype(np.float32)
