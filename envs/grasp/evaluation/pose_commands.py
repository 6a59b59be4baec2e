"""Poses that actions command in running episodes: what is judged outside of them, and drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.task import GoalRegion

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PoseCommands:
    """n commanded poses, and what they were chosen before.

    Attributes:
        scenes: the n scenes.
        region: what counts as right in them.
        tooltip_m: (n, 3) where the centre of the cup's face is sent, world frame.
        yaw_rad: (n,) the tool's yaw there.
        views: where each camera stands, by its name.
        images: each camera's observation (n, H, W, C) or (n, P, 4), by its name.
    """

    scenes: Scenes
    region: GoalRegion
    tooltip_m: Floats
    yaw_rad: Floats
    views: dict[str, CameraPoses]
    images: dict[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.yaw_rad)
