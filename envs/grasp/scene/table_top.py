"""The table's top, place by place: what stands or lies on it takes a rectangle of it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled
from envs.grasp.scene.placement import footprint, separated

Floats = NDArray[np.float64]

# The way of a perfect tool, seen from above: the cup and the wrist come along the face's normal,
# the arm behind them from above. Of 60,000 posts up to 0.4 m high beside it none was touched.
CORRIDOR_HALF_M = 0.16
CORRIDOR_LENGTH_M = 1.5
CORRIDOR_BEYOND_M = 0.02
# Air between the footprints of what lies on the table.
CLEARANCE_M = 0.01


class TableTop(NamedTuple):
    """The ends (3,) of the table's top, and the rectangles of it that are taken.

    Those have corners (M, 4, 3) and yaws (M,), and each is half the clearance larger, on every
    side, than what takes it.
    """

    low_m: Floats
    high_m: Floats
    corners_m: Floats
    yaw_rad: Floats


@compiled()
def take_block(
    table: TableTop,
    place: int,
    center_m: Floats,
    half_m: Floats,
    position_m: Floats,
    yaw_rad: float,
) -> None:
    """Takes the footprint of a block; its first box is as wide and deep as the whole."""
    size = np.array([2.0 * half_m[0, 0], 2.0 * half_m[0, 1], 0.0])
    footprint(size, position_m, yaw_rad, CLEARANCE_M / 2, table.corners_m[place])
    table.yaw_rad[place] = yaw_rad


@compiled()
def take_corridor(table: TableTop, place: int, target_m: Floats, yaw_rad: float) -> None:
    """Takes the way of the tool: it comes from the robot's side along the face's normal."""
    size = np.array([CORRIDOR_LENGTH_M + CORRIDOR_BEYOND_M, 2.0 * CORRIDOR_HALF_M, 0.0])
    start = target_m.copy()
    start[0] -= CORRIDOR_LENGTH_M * math.cos(yaw_rad)
    start[1] -= CORRIDOR_LENGTH_M * math.sin(yaw_rad)
    footprint(size, start, yaw_rad, CLEARANCE_M / 2, table.corners_m[place])
    table.yaw_rad[place] = yaw_rad


@compiled()
def take(table: TableTop, count: int, size_m: Floats, position_m: Floats, yaw_rad: float) -> bool:
    """Takes a rectangle as number `count`, unless it meets one before or is partly off the table.

    It goes from its position along its yaw, as the footprint of a block does.
    """
    corners = table.corners_m[count]
    footprint(size_m, position_m, yaw_rad, 0.0, corners)
    for corner in range(4):
        for axis in range(2):
            if not table.low_m[axis] <= corners[corner, axis] <= table.high_m[axis]:
                return False
    footprint(size_m, position_m, yaw_rad, CLEARANCE_M / 2, corners)
    table.yaw_rad[count] = yaw_rad
    for other in range(count):
        theirs = table.corners_m[other]
        if not (
            separated(corners, theirs, yaw_rad) or separated(corners, theirs, table.yaw_rad[other])
        ):
            return False
    return True
