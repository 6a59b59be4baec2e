from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from envs.grasp.scene.sampler import Scenes

# Position (x, y), yaw (rad) and size (depth, width, height) of a block that is one box.
BoxBlock = tuple[tuple[float, float], float, tuple[float, float, float]]


@pytest.fixture(scope="session")
def box_scene() -> Callable[[Sequence[BoxBlock]], Scenes]:
    """Builds one scene by hand: blocks of a single box on a table 0.6 m high."""

    def build(blocks: Sequence[BoxBlock]) -> Scenes:
        count = len(blocks)
        center, half = np.zeros((1, count, 3, 3)), np.zeros((1, count, 3, 3))
        position, yaw = np.zeros((1, count, 3)), np.zeros((1, count))
        for number, ((x, y), turn, size) in enumerate(blocks):
            center[0, number, 0] = [size[0] / 2, 0.0, size[2] / 2]
            half[0, number, 0] = np.array(size) / 2
            position[0, number], yaw[0, number] = [x, y, 0.6], turn
        return Scenes(
            box_center_m=center,
            box_half_m=half,
            block_position_m=position,
            block_yaw_rad=yaw,
            target_m=position[:, 0] + [0.0, 0.0, blocks[0][2][2] / 2],
            around_center_m=np.zeros((1, 0, 3)),
            around_rotation=np.zeros((1, 0, 3, 3)),
            around_half_m=np.zeros((1, 0, 3)),
            light_direction=np.array([[0.0, 0.0, 1.0]]),
            light_intensity=np.array([0.6]),
        )

    return build
