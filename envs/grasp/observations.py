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
from envs.grasp.sensors.camera import CameraPoses, pinhole, sampling
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.base import Simulator

PRIVILEGED = "privileged"
POSES_AND_PROGRESS, LIMITS = 18, 4
# Brings the privileged numbers near 1: positions are decimetres off the workspace's middle.
WORKSPACE_MIDDLE_M = np.array([1.05, 0.0, 0.75])
DECIMETRES_PER_M = 10.0


def observation_space(settings: GraspSettings) -> gymnasium.spaces.Dict:
    """The space of one environment's observations."""
    spaces: dict[str, gymnasium.Space[Any]] = {}
    for name, camera in settings.cameras.items():
        sampled = sampling(camera)
        shape = (sampled.height, sampled.width)
        if camera.type == "depth":
            spaces[name] = DepthImage(
                *shape, camera.range_m, camera.encoding, pinhole(camera), sampled
            )
        else:
            spaces[name] = RgbImage(*shape, sampled)
    if settings.privileged:
        size = POSES_AND_PROGRESS + (LIMITS if settings.privileged_limits else 0)
        spaces[PRIVILEGED] = Box(-np.inf, np.inf, (size,), np.float32)
    return gymnasium.spaces.Dict(spaces)


def take_images(
    simulator: Simulator,
    indices: NDArray[np.int64],
    views: Mapping[str, CameraPoses],
    spaces: Mapping[str, gymnasium.Space[Any]],
    rng: np.random.Generator,
) -> dict[str, NDArray[Any]]:
    """Images (n, H, W, C) as cameras deliver them now, by their names.

    Args:
        simulator: holds the worlds.
        indices: of the n worlds.
        views: the cameras.
        spaces: of their images; a mapping or a space of spaces.
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
