"""The contract of a simulator: one interface, several engines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import DepthImage
from envs.environment import EnvironmentFailure
from envs.grasp.robot.paths import Path
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses

Indices = NDArray[np.int64]
Floats = NDArray[np.float64]
Images = NDArray[Any]


class SimulatorError(EnvironmentFailure):
    """The engine stopped working."""


@dataclass(frozen=True)
class Contacts:
    """Contacts along n motions.

    Attributes:
        touched: (n,) the cup touched the target block.
        collided: (n,) any link touched a block, the support or what stands around, or the cup
            touched any of these but the target block.
    """

    touched: NDArray[np.bool_]
    collided: NDArray[np.bool_]


class Simulator(Protocol):
    """N worlds, each with the robot, the support, and the blocks and surroundings of one scene.

    Every call names the n worlds it is about by `indices` (n,), rising and without repeats.
    """

    def load(self, indices: Indices, scenes: Scenes, joints_rad: Floats) -> None:
        """Puts what stands in n scenes in place and the robots' joints at (n, 6)."""

    def move(self, indices: Indices, path_rad: Path, resolution_m: float) -> Contacts:
        """Moves n robots along paths, and stays at their ends.

        Args:
            indices: the worlds (n,).
            path_rad: (n, 2 k + 1, 6), see `envs.grasp.robot.paths`; one knot is a pose.
            resolution_m: no point of the robot that could touch anything moves more than this
                between two looks. What nothing can touch before the next look is not looked at.

        Returns:
            What was touched anywhere along the paths, their ends included.
        """

    def render(self, indices: Indices, views: CameraPoses) -> Images:
        """Takes n pictures.

        Returns:
            Depth in metres, (n, H, W) float32, infinite where nothing lies before the far plane; or
            RGB (n, H, W, 3) uint8, by the camera's type.
        """

    def render_depth(
        self, indices: Indices, views: CameraPoses, space: DepthImage, seeds: NDArray[np.uint64]
    ) -> Images:
        """Takes n depth pictures as the sensor delivers them.

        Args:
            indices: the worlds (n,).
            views: the depth cameras, with their noise.
            space: the range, and how it is encoded.
            seeds: (n,) of all that is random in each picture.

        Returns:
            (n, H, W, 1) in the space's type.
        """

    def close(self) -> None:
        """Frees what the engine holds; calling it twice does no harm."""
