"""Where the blocks stand: drawn at random until every rule is kept, one scene after the other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from envs.grasp.blocks import MAX_BAR_SHARE, MIN_BAR_M, SHAPE_CODES, build_block
from envs.grasp.camera import focal_length_px
from envs.grasp.settings import GraspSettings

Floats = NDArray[np.float64]

# Air between the footprints of two blocks, so that touching one is not touching the other.
BLOCK_CLEARANCE_M = 0.02
# The goal lies up to 2 cm in front of a face; so far inside the workspace a grasp point must be.
WORKSPACE_MARGIN_M = 0.03
MAX_TRIES = 20_000


class Rules(NamedTuple):
    """What a scene has to obey, as plain numbers and arrays; ranges are (low, high)."""

    shapes: NDArray[np.int64]
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    size_m: Floats
    depth_m: Floats
    lead_m: float
    grasp_at_centroid: bool
    support_low_m: Floats
    support_high_m: Floats
    workspace_low: Floats
    workspace_high: Floats
    image_px: Floats
    focal_px: Floats


def rules(settings: GraspSettings) -> Rules:
    """The rules of a run's scenes."""
    randomize, support, workspace = settings.randomize, settings.support, settings.workspace
    poses = (workspace.x_m, workspace.y_m, workspace.z_m, np.radians(workspace.yaw_deg))
    low, high = np.array(poses, float).T
    cameras = settings.cameras.values()
    return Rules(
        shapes=np.array([SHAPE_CODES[shape] for shape in randomize.shapes]),
        x_m=np.array(randomize.block_x_m),
        y_m=np.array(randomize.block_y_m),
        yaw_rad=np.radians(randomize.block_yaw_deg),
        size_m=np.array(randomize.block_size_m),
        depth_m=np.array(randomize.block_depth_m),
        lead_m=settings.target_lead_m,
        grasp_at_centroid=settings.grasp_point == "centroid",
        support_low_m=np.array([support.x_m[0], support.y_m[0], support.top_m]),
        support_high_m=np.array([support.x_m[1], support.y_m[1], support.top_m]),
        workspace_low=low + WORKSPACE_MARGIN_M * np.array([1.0, 1.0, 1.0, 0.0]),
        workspace_high=high - WORKSPACE_MARGIN_M * np.array([1.0, 1.0, 1.0, 0.0]),
        image_px=np.array([[camera.width, camera.height] for camera in cameras], float),
        focal_px=np.array([focal_length_px(camera) for camera in cameras]),
    )


@numba.njit(cache=True)
def place_blocks(
    rng: np.random.Generator,
    rules: Rules,
    yaw_limit_rad: Floats,
    camera_m: Floats,
    camera_rotation: Floats,
    box_center_m: Floats,
    box_half_m: Floats,
    position_m: Floats,
    yaw_rad: Floats,
    target_m: Floats,
) -> bool:
    """Places B blocks in each of n scenes, the nearest to the robot first.

    Args:
        rng: the source of randomness.
        rules: what the scenes obey.
        yaw_limit_rad: (n,) narrows the range of the yaw to +- this.
        camera_m: (n, C, 3) the cameras' optical centres.
        camera_rotation: (n, C, 3, 3) the cameras' axes as columns.
        box_center_m: (n, B, 3, 3) written, as the following are: fields of `Scenes`.
        box_half_m: (n, B, 3, 3).
        position_m: (n, B, 3).
        yaw_rad: (n, B).
        target_m: (n, 3).

    Returns:
        False if some scene was not found in `MAX_TRIES` tries.
    """
    count = position_m.shape[1]
    size_m = np.empty((count, 3))
    for row in range(len(target_m)):
        for _ in range(MAX_TRIES):
            if not _draw_positions(rng, rules, position_m[row]):
                continue
            _draw_yaws(rng, rules, yaw_limit_rad[row], yaw_rad[row])
            for block in range(count):
                point = _draw_block(
                    rng, rules, size_m[block], box_center_m[row, block], box_half_m[row, block]
                )
                if block == 0:
                    _to_world(
                        0.0, point[0], point[1], position_m[row, 0], yaw_rad[row, 0], target_m[row]
                    )
            if (
                _reachable(rules, target_m[row], yaw_rad[row, 0])
                and _apart_on_support(rules, size_m, position_m[row], yaw_rad[row])
                and _seen(
                    rules,
                    size_m,
                    position_m[row],
                    yaw_rad[row],
                    camera_m[row],
                    camera_rotation[row],
                )
            ):
                break
        else:
            return False
    return True


@numba.njit(cache=True)
def _draw_positions(rng: np.random.Generator, rules: Rules, position_m: Floats) -> bool:
    """Draws where the blocks stand, by rising distance; False if the first is not ahead enough."""
    count = len(position_m)
    for block in range(count):
        x, y = rng.uniform(rules.x_m[0], rules.x_m[1]), rng.uniform(rules.y_m[0], rules.y_m[1])
        place = block
        while place > 0 and math.hypot(
            position_m[place - 1, 0], position_m[place - 1, 1]
        ) > math.hypot(x, y):
            position_m[place] = position_m[place - 1]
            place -= 1
        position_m[place] = x, y, rules.support_low_m[2]
    if count == 1:
        return True
    first = math.hypot(position_m[0, 0], position_m[0, 1])
    return math.hypot(position_m[1, 0], position_m[1, 1]) - first >= rules.lead_m


@numba.njit(cache=True)
def _draw_yaws(rng: np.random.Generator, rules: Rules, limit_rad: float, yaw_rad: Floats) -> None:
    low = min(max(rules.yaw_rad[0], -limit_rad), limit_rad)
    high = min(max(rules.yaw_rad[1], -limit_rad), limit_rad)
    for block in range(len(yaw_rad)):
        yaw_rad[block] = rng.uniform(low, high)


@numba.njit(cache=True)
def _draw_block(
    rng: np.random.Generator, rules: Rules, size_m: Floats, center_m: Floats, half_m: Floats
) -> tuple[float, float]:
    """Draws a block's shape and dimensions; returns the grasp point (y, z) on its face."""
    shape = rules.shapes[rng.integers(0, len(rules.shapes))]
    size_m[0] = rng.uniform(rules.depth_m[0], rules.depth_m[1])
    size_m[1] = rng.uniform(rules.size_m[0], rules.size_m[1])
    size_m[2] = rng.uniform(rules.size_m[0], rules.size_m[1])
    bar_m = rng.uniform(MIN_BAR_M, max(MIN_BAR_M, MAX_BAR_SHARE * size_m[2]))
    disc_y, disc_z, centroid_y, centroid_z = build_block(
        shape, size_m, bar_m, rng.random(), rng.random() < 0.5, center_m, half_m
    )
    return (centroid_y, centroid_z) if rules.grasp_at_centroid else (disc_y, disc_z)


@numba.njit(cache=True)
def _to_world(
    x: float, y: float, z: float, position_m: Floats, yaw_rad: float, point_m: Floats
) -> None:
    """Writes a point of a body frame in the world frame."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    point_m[0] = position_m[0] + cosine * x - sine * y
    point_m[1] = position_m[1] + sine * x + cosine * y
    point_m[2] = position_m[2] + z


@numba.njit(cache=True)
def _reachable(rules: Rules, target_m: Floats, yaw_rad: float) -> bool:
    for axis in range(3):
        if not rules.workspace_low[axis] <= target_m[axis] <= rules.workspace_high[axis]:
            return False
    return rules.workspace_low[3] <= yaw_rad <= rules.workspace_high[3]


@numba.njit(cache=True)
def _footprint(
    size_m: Floats, position_m: Floats, yaw_rad: float, grow_m: float, corners_m: Floats
) -> None:
    """Writes the four corners (4, 3) of a block seen from above, grown on every side."""
    near, far = -grow_m, size_m[0] + grow_m
    side = size_m[1] / 2 + grow_m
    _to_world(near, -side, 0.0, position_m, yaw_rad, corners_m[0])
    _to_world(far, -side, 0.0, position_m, yaw_rad, corners_m[1])
    _to_world(far, side, 0.0, position_m, yaw_rad, corners_m[2])
    _to_world(near, side, 0.0, position_m, yaw_rad, corners_m[3])


@numba.njit(cache=True)
def _apart_on_support(rules: Rules, size_m: Floats, position_m: Floats, yaw_rad: Floats) -> bool:
    """Whether all blocks stand wholly on the support, and well apart."""
    count = len(size_m)
    corners = np.empty((count, 4, 3))
    for block in range(count):
        _footprint(size_m[block], position_m[block], yaw_rad[block], 0.0, corners[block])
        for corner in range(4):
            for axis in range(2):
                value = corners[block, corner, axis]
                if not rules.support_low_m[axis] <= value <= rules.support_high_m[axis]:
                    return False
        _footprint(
            size_m[block], position_m[block], yaw_rad[block], BLOCK_CLEARANCE_M / 2, corners[block]
        )
        for other in range(block):
            if not (
                _separated(corners[block], corners[other], yaw_rad[block])
                or _separated(corners[block], corners[other], yaw_rad[other])
            ):
                return False
    return True


@numba.njit(cache=True)
def _separated(first_m: Floats, second_m: Floats, yaw_rad: float) -> bool:
    """Whether a line along or across `yaw` separates two rectangles (4, 3) seen from above."""
    for angle in (yaw_rad, yaw_rad + math.pi / 2):
        x, y = math.cos(angle), math.sin(angle)
        first = first_m[:, 0] * x + first_m[:, 1] * y
        second = second_m[:, 0] * x + second_m[:, 1] * y
        if first.max() < second.min() or second.max() < first.min():
            return True
    return False


@numba.njit(cache=True)
def _seen(
    rules: Rules,
    size_m: Floats,
    position_m: Floats,
    yaw_rad: Floats,
    camera_m: Floats,
    camera_rotation: Floats,
) -> bool:
    """Whether every block's face lies inside the image of every camera."""
    corner = np.empty(3)
    for block in range(len(size_m)):
        for side in (-0.5, 0.5):
            for height in (0.0, 1.0):
                _to_world(
                    0.0,
                    side * size_m[block, 1],
                    height * size_m[block, 2],
                    position_m[block],
                    yaw_rad[block],
                    corner,
                )
                for camera in range(len(camera_m)):
                    # Not a matrix product: numba would want SciPy for it.
                    ray, axes = corner - camera_m[camera], camera_rotation[camera]
                    x, y = (ray * axes[:, 0]).sum(), (ray * axes[:, 1]).sum()
                    depth = (ray * axes[:, 2]).sum()
                    width, rows = rules.image_px[camera]
                    focal = rules.focal_px[camera]
                    if (
                        depth <= 0.0
                        or abs(x) * focal > depth * width / 2
                        or abs(y) * focal > depth * rows / 2
                    ):
                        return False
    return True
