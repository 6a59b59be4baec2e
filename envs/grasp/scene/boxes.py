"""Boxes of any orientation, as kernels build, move and look past them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled

Floats = NDArray[np.float64]
Point = tuple[float, float, float]


class Boxes(NamedTuple):
    """K boxes in the world frame, or those of one part: a size of zero where there is none."""

    center_m: Floats
    rotation: Floats
    half_m: Floats


@compiled()
def part(boxes: Boxes, begin: int, end: int) -> Boxes:
    """The boxes from `begin` to `end`."""
    return Boxes(boxes.center_m[begin:end], boxes.rotation[begin:end], boxes.half_m[begin:end])


@compiled()
def put(
    boxes: Boxes, box: int, center_m: Point, half_m: Point, yaw_rad: float, pitch_rad: float
) -> None:
    """Writes a box that is first pitched about y, its top towards +x, then turned by its yaw."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    level, steep = math.cos(pitch_rad), math.sin(pitch_rad)
    turn = boxes.rotation[box]
    turn[0, 0], turn[0, 1], turn[0, 2] = cosine * level, -sine, cosine * steep
    turn[1, 0], turn[1, 1], turn[1, 2] = sine * level, cosine, sine * steep
    turn[2, 0], turn[2, 1], turn[2, 2] = -steep, 0.0, level
    for axis in range(3):
        boxes.center_m[box, axis], boxes.half_m[box, axis] = center_m[axis], half_m[axis]


@compiled()
def move(boxes: Boxes, position_m: Floats, yaw_rad: float) -> None:
    """Turns boxes about the origin's vertical, then moves them there."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    for box in range(len(boxes.half_m)):
        x, y = boxes.center_m[box, 0], boxes.center_m[box, 1]
        boxes.center_m[box, 0] = position_m[0] + cosine * x - sine * y
        boxes.center_m[box, 1] = position_m[1] + sine * x + cosine * y
        boxes.center_m[box, 2] += position_m[2]
        for column in range(3):
            x, y = boxes.rotation[box, 0, column], boxes.rotation[box, 1, column]
            boxes.rotation[box, 0, column] = cosine * x - sine * y
            boxes.rotation[box, 1, column] = sine * x + cosine * y


@compiled()
def clear(boxes: Boxes) -> None:
    """Takes boxes away."""
    boxes.center_m[:], boxes.rotation[:], boxes.half_m[:] = 0.0, 0.0, 0.0


@compiled()
def outline(boxes: Boxes) -> tuple[Floats, Floats]:
    """The ends (3,) of the room that boxes take."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for box in range(len(boxes.half_m)):
        if boxes.half_m[box, 0] == 0.0:
            continue
        for axis in range(3):
            reach = 0.0
            for k in range(3):
                reach += abs(boxes.rotation[box, axis, k]) * boxes.half_m[box, k]
            low[axis] = min(low[axis], boxes.center_m[box, axis] - reach)
            high[axis] = max(high[axis], boxes.center_m[box, axis] + reach)
    return low, high


@compiled()
def shows(boxes: Boxes, camera_m: Floats, points_m: Floats) -> bool:
    """Whether every camera sees all of some points past boxes."""
    for box in range(len(boxes.half_m)):
        if boxes.half_m[box, 0] == 0.0:
            continue
        for camera in range(len(camera_m)):
            for point in range(len(points_m)):
                if _crosses(boxes, box, camera_m[camera], points_m[point]):
                    return False
    return True


@compiled()
def _crosses(boxes: Boxes, box: int, start_m: Floats, end_m: Floats) -> bool:
    """Whether a box has a point of a straight line, by the part of it between its faces."""
    enter, leave = 0.0, 1.0
    for k in range(3):
        along = offset = 0.0
        for axis in range(3):
            turn = boxes.rotation[box, axis, k]
            along += turn * (end_m[axis] - start_m[axis])
            offset += turn * (start_m[axis] - boxes.center_m[box, axis])
        half = boxes.half_m[box, k]
        if abs(along) < 1e-12:
            if abs(offset) > half:
                return False
            continue
        first, second = (-half - offset) / along, (half - offset) / along
        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    return enter <= leave
