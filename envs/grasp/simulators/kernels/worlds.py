"""The robot and the worlds as the kernels know them, and the poses of the robot's links."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]
Vector = tuple[float, float, float]


def kernel(*, counts: bool = True, **options: Any) -> Callable[..., Callable[..., Any]]:
    """A decorator that compiles a function; see `envs.grasp.compiled`.

    A division by zero is infinite, not an exception, which would be a branch in every loop.

    Every array that is sliced or given to a function costs two atomic additions, to its counter of
    references, and a tuple of arrays as many as it has: inner loops are given single arrays only,
    or do not count.

    Args:
        counts: references to arrays. A function that does not can make no arrays, and is called by
            functions that hold the arrays it is given.
        options: more of `numba.njit`'s.
    """
    return compiled(error_model="numpy", _nrt=counts, **options)


class RobotArrays(NamedTuple):
    """A robot of J joints, L links and S shapes; see `envs.grasp.robot.urdf.Robot`.

    Attributes:
        parents, joints: (L,) parent and joint of each link, -1 for none.
        origins: (L, 4, 4) frames in the parents' frames.
        axes: (J, 3) joint axes.
        shape_links: (S,) the link of each shape.
        shape_poses: (S, 4, 4) in the frames of the links.
        shape_half: (S, 3) half extents; of a cylinder the radius twice and half the length.
        shape_radius: (S,) of the ball about the shape.
        shape_reach: (S, J) see `envs.grasp.robot.kinematics.shape_reach`.
        is_cylinder, is_cup: (S,).
        shape_colors: (S, 3) in [0, 255].
    """

    parents: Integers
    joints: Integers
    origins: Floats
    axes: Floats
    shape_links: Integers
    shape_poses: Floats
    shape_half: Floats
    shape_radius: Floats
    shape_reach: Floats
    is_cylinder: Bools
    is_cup: Bools
    shape_colors: Floats


class WorldArrays(NamedTuple):
    """N worlds of up to K boxes, in the world frame.

    Attributes:
        center: (N, K, 3).
        axes: (N, K, 3, 3) whose columns are the boxes' axes.
        half: (N, K, 3) half extents, zero where there is no box.
        radius: (N, K) of the balls about the boxes.
        starts: (N, R + 1) first boxes of R rooms, of which each has those before the next one's:
            the support, the blocks, and what stands around. Behind the last is what can't be
            touched.
        low: (N, R, 3) lower ends of the rooms that these take.
        high: (N, R, 3) their upper ends.
        is_target: (N, K) whether the box belongs to the target block.
        colors: (N, K, 3) in [0, 255].
        light: (N, 3) unit vectors towards the light.
        diffuse: (N,) diffuse share of the light.
        joints: (N, 1, J) where the robot stands, in radians.
    """

    center: Floats
    axes: Floats
    half: Floats
    radius: Floats
    starts: Integers
    low: Floats
    high: Floats
    is_target: Bools
    colors: Floats
    light: Floats
    diffuse: Floats
    joints: Floats


@kernel(counts=False)
def dot(first: Vector, second: Vector) -> float:
    """The inner product."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@kernel(counts=False)
def minus(first: Vector, second: Vector) -> Vector:
    """The difference."""
    return first[0] - second[0], first[1] - second[1], first[2] - second[2]


@kernel(counts=False)
def cross(first: Vector, second: Vector) -> Vector:
    """The cross product."""
    return (
        first[1] * second[2] - first[2] * second[1],
        first[2] * second[0] - first[0] * second[2],
        first[0] * second[1] - first[1] * second[0],
    )


@kernel(counts=False)
def move_links(
    parents: Integers,
    joints: Integers,
    origins: Floats,
    axes: Floats,
    paths: Floats,
    row: int,
    pose: int,
    frames: Floats,
) -> None:
    """Puts the frames of all links of a robot (see `RobotArrays`) into `frames` (L, 3, 4).

    The joint angles are those of `paths` (n, p, J) at the row and the pose.
    """
    for link in range(len(parents)):
        parent, joint = parents[link], joints[link]
        for i in range(3):
            if parent < 0:
                for j in range(4):
                    frames[link, i, j] = origins[link, i, j]
                continue
            a, b, c = frames[parent, i, 0], frames[parent, i, 1], frames[parent, i, 2]
            for j in range(4):
                frames[link, i, j] = (
                    a * origins[link, 0, j] + b * origins[link, 1, j] + c * origins[link, 2, j]
                )
            frames[link, i, 3] += frames[parent, i, 3]
        if joint >= 0:
            axis = (axes[joint, 0], axes[joint, 1], axes[joint, 2])
            _turn(frames, link, axis, paths[row, pose, joint])


@kernel(counts=False)
def _turn(frames: Floats, link: int, axis: Vector, angle: float) -> None:
    """Turns a frame about one of its own directions, by Rodrigues' formula for each of its rows."""
    x, y, z = axis
    sine, cosine = math.sin(angle), math.cos(angle)
    for i in range(3):
        a, b, c = frames[link, i, 0], frames[link, i, 1], frames[link, i, 2]
        along = (1.0 - cosine) * (a * x + b * y + c * z)
        # The row times R: v cos + (v x axis) sin + axis (axis . v) (1 - cos)
        frames[link, i, 0] = a * cosine + (b * z - c * y) * sine + x * along
        frames[link, i, 1] = b * cosine + (c * x - a * z) * sine + y * along
        frames[link, i, 2] = c * cosine + (a * y - b * x) * sine + z * along


@kernel(counts=False)
def in_world(frames: Floats, link: int, x: float, y: float, z: float) -> Vector:
    """A point of a link, in the world."""
    return (
        frames[link, 0, 0] * x
        + frames[link, 0, 1] * y
        + frames[link, 0, 2] * z
        + frames[link, 0, 3],
        frames[link, 1, 0] * x
        + frames[link, 1, 1] * y
        + frames[link, 1, 2] * z
        + frames[link, 1, 3],
        frames[link, 2, 0] * x
        + frames[link, 2, 1] * y
        + frames[link, 2, 2] * z
        + frames[link, 2, 3],
    )


@kernel(counts=False)
def column_in_world(frames: Floats, link: int, poses: Floats, shape: int, k: int) -> Vector:
    """Column `k` of one of the `poses` (S, 4, 4) of a link's shapes, a direction, in the world."""
    x, y, z = poses[shape, 0, k], poses[shape, 1, k], poses[shape, 2, k]
    return (
        frames[link, 0, 0] * x + frames[link, 0, 1] * y + frames[link, 0, 2] * z,
        frames[link, 1, 0] * x + frames[link, 1, 1] * y + frames[link, 1, 2] * z,
        frames[link, 2, 0] * x + frames[link, 2, 1] * y + frames[link, 2, 2] * z,
    )


@kernel(counts=False)
def triple(values: Floats, i: int, j: int) -> Vector:
    """The three numbers values[i, j]."""
    return values[i, j, 0], values[i, j, 1], values[i, j, 2]
