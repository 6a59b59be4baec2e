"""Paths through joint space: legs one after the other, each a parabola through three knots.

A straight motion of the tool bends in joint space. A parabola follows it so much more closely than
a chord that a few legs are as good as the straight line; see `envs.grasp.robot.approach`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.grasp.robot.urdf import Robot

Floats = NDArray[np.float64]
Path = Floats
"""Knots (..., 2 k + 1, J) of k legs: a leg's begin, its middle, the next one's begin, and so on."""


def straight_leg(start: Floats, end: Floats) -> Path:
    """The straight way (..., 3, J) through joint space between joint angles (..., J)."""
    return np.stack([start, (start + end) / 2.0, end], axis=-2)


def joined(*paths: Path) -> Path:
    """One path of several, each of which begins where the one before it ends."""
    first, *others = paths
    return np.concatenate([first, *(path[..., 1:, :] for path in others)], axis=-2)


def legs(path: Path) -> Floats:
    """The legs (..., k, 3, J) of paths (..., 2 k + 1, J).

    Raises:
        ValueError: the number of knots is even.
    """
    check_knots(path)
    return np.stack([path[..., :-2:2, :], path[..., 1:-1:2, :], path[..., 2::2, :]], axis=-2)


def leg_poses(leg: Floats, part: Floats) -> Floats:
    """Joint angles (..., p, J) at parts (p,) in [0, 1] of legs (..., 3, J): Lagrange's formula."""
    t = np.asarray(part)[:, None]
    start, middle, end = (leg[..., knot : knot + 1, :] for knot in range(3))
    return (
        (1.0 - t) * (1.0 - 2.0 * t) * start
        + 4.0 * t * (1.0 - t) * middle
        + t * (2.0 * t - 1.0) * end
    )


def path_poses(path: Path, part: Floats) -> Floats:
    """Joint angles (p, J) at parts (p,) in [0, 1] of a path (2 k + 1, J), its legs equally long."""
    along = legs(path)
    place = np.asarray(part) * len(along)
    number = np.minimum(place.astype(int), len(along) - 1)
    poses = np.empty((len(place), path.shape[-1]))
    for leg in range(len(along)):
        poses[number == leg] = leg_poses(along[leg], place[number == leg] - leg)
    return poses


def leg_speeds(leg: Floats) -> Floats:
    """Upper bounds (J,) of |dq/dt| along a leg (3, J): it is linear, and largest at an end."""
    start, middle, end = leg
    return np.maximum(
        np.abs(4.0 * middle - 3.0 * start - end), np.abs(3.0 * end + start - 4.0 * middle)
    )


def duration_s(robot: Robot, path: Path) -> Floats:
    """Time (...) that paths take.

    From knot to knot the slowest joint moves at its largest speed, the others keep pace with it.
    Acceleration is left out.
    """
    turns = np.abs(np.diff(path, axis=-2))
    return np.asarray(np.max(turns / robot.max_speed_rad_s, axis=-1).sum(axis=-1))


def check_knots(path: Path) -> None:
    """Raises ValueError where the number of knots is even."""
    if np.ndim(path) < 2 or np.shape(path)[-2] % 2 == 0:
        raise ValueError(
            f"a path of k legs has 2 k + 1 knots (..., 2 k + 1, J), not the shape {np.shape(path)}"
        )
