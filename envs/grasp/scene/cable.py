"""A cable: a chain of thin boxes that lies on the table, or hangs over one of its edges."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled
from envs.grasp.scene.boxes import Boxes, clear, put, shows
from envs.grasp.scene.table_top import TableTop, take
from envs.grasp.threefry import uniform

Floats = NDArray[np.float64]
Stream = NDArray[np.uint64]

CABLE_BOXES = 5
HANGING = 0.5
BEND_RAD = SWING_RAD = math.radians(25.0)
TRIES = 50


@compiled()
def draw_cable(
    stream: Stream,
    thickness_m: Floats,
    boxes: Boxes,
    table: TableTop,
    count: int,
    camera_m: Floats,
    disc_m: Floats,
) -> None:
    """Draws a cable among `count` places that are taken; none, where it finds no way.

    Args:
        stream: see `threefry.uniform`.
        thickness_m: (2,) its range.
        boxes: written, `CABLE_BOXES`.
        table: where it may lie.
        count: of the table's places.
        camera_m: (C, 3) optical centres of the cameras.
        disc_m: (k, 3) points that it hides from none of them.
    """
    half = uniform(stream, thickness_m[0], thickness_m[1]) / 2
    hangs, end = uniform(stream, 0.0, 1.0) < HANGING, np.empty(3)
    for _ in range(TRIES):
        clear(boxes)
        if hangs:
            first = _hang(stream, table, boxes, half, end)
        else:
            first = _begin_anywhere(stream, table, end)
        if _lay(stream, boxes, first, half, end, table, count) and shows(boxes, camera_m, disc_m):
            return
    clear(boxes)


@compiled()
def _begin_anywhere(stream: Stream, table: TableTop, end: Floats) -> int:
    """Begins a cable on the table: writes x, y and the heading of its free end."""
    for axis in range(2):
        end[axis] = uniform(stream, table.low_m[axis], table.high_m[axis])
    end[2] = uniform(stream, -math.pi, math.pi)
    return 0


@compiled()
def _hang(stream: Stream, table: TableTop, boxes: Boxes, half_m: float, end: Floats) -> int:
    """Hangs two boxes of a cable over a side of the table or its far edge.

    Writes x, y and the heading of the end that lies on the table; returns the number of boxes.
    """
    low, high = table.low_m, table.high_m
    x, y = uniform(stream, low[0], high[0]), uniform(stream, low[1], high[1])
    edge = int(uniform(stream, 0.0, 3.0))
    if edge == 0:
        x, out = high[0], 0.0
    else:
        y, out = (high[1], math.pi / 2) if edge == 1 else (low[1], -math.pi / 2)
    down, on = uniform(stream, 0.08, 0.2), uniform(stream, 0.08, 0.2)
    ahead, aside = math.cos(out), math.sin(out)
    end[0], end[1], end[2] = x - half_m * ahead, y - half_m * aside, out + math.pi
    x, y, z = x + half_m * ahead, y + half_m * aside, high[2] + 2.0 * half_m - down
    put(boxes, 0, (x, y, z + down / 2), (half_m, half_m, down / 2), out, 0.0)
    # The lower part swings along the edge.
    swing = uniform(stream, -SWING_RAD, SWING_RAD)
    x += on / 2 * math.sin(swing) * aside
    y -= on / 2 * math.sin(swing) * ahead
    z -= on / 2 * math.cos(swing)
    put(boxes, 1, (x, y, z), (half_m, half_m, on / 2), out + math.pi / 2, swing)
    return 2


@compiled()
def _lay(
    stream: Stream,
    boxes: Boxes,
    first: int,
    half_m: float,
    end: Floats,
    table: TableTop,
    count: int,
) -> bool:
    """Lays the boxes from `first` on, each from the end of the one before; False if one can't."""
    for box in range(first, CABLE_BOXES):
        yaw = end[2] + uniform(stream, -BEND_RAD, BEND_RAD)
        length = uniform(stream, 0.05, 0.12)
        start = np.array([end[0], end[1], table.high_m[2]])
        if not take(table, count, np.array([length, 2.0 * half_m, 0.0]), start, yaw):
            return False
        x, y = math.cos(yaw), math.sin(yaw)
        middle = (start[0] + length / 2 * x, start[1] + length / 2 * y, start[2] + half_m)
        # Longer by half its thickness at both ends, so that no bend has a gap.
        put(boxes, box, middle, (length / 2 + half_m, half_m, half_m), yaw, 0.0)
        end[0], end[1], end[2] = start[0] + length * x, start[1] + length * y, yaw
    return True
