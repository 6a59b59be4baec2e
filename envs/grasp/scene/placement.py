"""Placement of the blocks: drawn at random until every rule is kept, one scene after the other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled
from envs.grasp.scene.blocks import MAX_BAR_SHARE, MIN_BAR_M, SHAPE_CODES, build_block
from envs.grasp.sensors.camera import sampling
from envs.grasp.settings import GraspSettings
from envs.grasp.threefry import uniform

Floats = NDArray[np.float64]
Stream = NDArray[np.uint64]

# Air between the footprints of two blocks, so that touching one is not touching the other.
BLOCK_CLEARANCE_M = 0.02
# The goal lies up to 2 cm in front of a face; so far inside the workspace a grasp point must be.
WORKSPACE_MARGIN_M = 0.03
MAX_TRIES = 20_000


class Rules(NamedTuple):
    """Rules that a scene obeys, as plain numbers and arrays; ranges are (low, high)."""

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
        image_px=np.array([[taken.width, taken.height] for taken in map(sampling, cameras)], float),
    )


@compiled(nogil=True)
def place_blocks(
    rules: Rules,
    streams: NDArray[np.uint64],
    yaw_limit_rad: Floats,
    camera_m: Floats,
    camera_rotation: Floats,
    intrinsics: Floats,
    box_center_m: Floats,
    box_half_m: Floats,
    position_m: Floats,
    yaw_rad: Floats,
    target_m: Floats,
    found: NDArray[np.bool_],
    begin: int,
    end: int,
) -> None:
    """Places B blocks in the scenes from `begin` to `end` of n, the nearest to the robot first.

    Args:
        rules: what the scenes obey.
        streams: (n, 2) each scene's source of randomness; see `threefry.uniform`.
        yaw_limit_rad: (n,) narrows the range of the yaw to +- this.
        camera_m: (n, C, 3) the cameras' optical centres.
        camera_rotation: (n, C, 3, 3) the cameras' axes as columns.
        intrinsics: (n, C, 4) their fx, fy, cx, cy in pixels.
        box_center_m: (n, B, 3, 3) written, as the following are: fields of `Scenes`.
        box_half_m: (n, B, 3, 3).
        position_m: (n, B, 3).
        yaw_rad: (n, B).
        target_m: (n, 3).
        found: (n,) False where no scene was found in `MAX_TRIES` tries.
        begin: the first row.
        end: the row after the last.
    """
    size_m = np.empty((position_m.shape[1], 3))
    for row in range(begin, end):
        found[row] = False
        for _ in range(MAX_TRIES):
            found[row] = _draw_scene(
                streams[row],
                rules,
                yaw_limit_rad[row],
                size_m,
                box_center_m[row],
                box_half_m[row],
                position_m[row],
                yaw_rad[row],
                target_m[row],
            ) and _seen(
                rules,
                size_m,
                position_m[row],
                yaw_rad[row],
                camera_m[row],
                camera_rotation[row],
                intrinsics[row],
            )
            if found[row]:
                break


@compiled()
def _draw_scene(
    stream: Stream,
    rules: Rules,
    yaw_limit_rad: float,
    size_m: Floats,
    box_center_m: Floats,
    box_half_m: Floats,
    position_m: Floats,
    yaw_rad: Floats,
    target_m: Floats,
) -> bool:
    """Draws one scene's blocks; False where they do not stand as they should."""
    if not _draw_positions(stream, rules, position_m):
        return False
    _draw_yaws(stream, rules, yaw_limit_rad, yaw_rad)
    for block in range(len(position_m)):
        point = _draw_block(stream, rules, size_m[block], box_center_m[block], box_half_m[block])
        if block == 0:
            _to_world(0.0, point[0], point[1], position_m[0], yaw_rad[0], target_m)
    return _reachable(rules, target_m, yaw_rad[0]) and _apart_on_support(
        rules, size_m, position_m, yaw_rad
    )


@compiled()
def _draw_positions(stream: Stream, rules: Rules, position_m: Floats) -> bool:
    """Draws where the blocks stand, by rising distance; False if the first is not ahead enough."""
    count = len(position_m)
    for block in range(count):
        x = uniform(stream, rules.x_m[0], rules.x_m[1])
        y = uniform(stream, rules.y_m[0], rules.y_m[1])
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


@compiled()
def _draw_yaws(stream: Stream, rules: Rules, limit_rad: float, yaw_rad: Floats) -> None:
    low = min(max(rules.yaw_rad[0], -limit_rad), limit_rad)
    high = min(max(rules.yaw_rad[1], -limit_rad), limit_rad)
    for block in range(len(yaw_rad)):
        yaw_rad[block] = uniform(stream, low, high)


@compiled()
def _draw_block(
    stream: Stream, rules: Rules, size_m: Floats, center_m: Floats, half_m: Floats
) -> tuple[float, float]:
    """Draws a block's shape and dimensions; returns the grasp point (y, z) on its face."""
    shape = rules.shapes[int(uniform(stream, 0.0, len(rules.shapes)))]
    size_m[0] = uniform(stream, rules.depth_m[0], rules.depth_m[1])
    size_m[1] = uniform(stream, rules.size_m[0], rules.size_m[1])
    size_m[2] = uniform(stream, rules.size_m[0], rules.size_m[1])
    bar_m = uniform(stream, MIN_BAR_M, max(MIN_BAR_M, MAX_BAR_SHARE * size_m[2]))
    leg_share, on_left = uniform(stream, 0.0, 1.0), uniform(stream, 0.0, 1.0) < 0.5
    disc_y, disc_z, centroid_y, centroid_z = build_block(
        shape, size_m, bar_m, leg_share, on_left, center_m, half_m
    )
    return (centroid_y, centroid_z) if rules.grasp_at_centroid else (disc_y, disc_z)


@compiled()
def _to_world(
    x: float, y: float, z: float, position_m: Floats, yaw_rad: float, point_m: Floats
) -> None:
    """Writes a point of a body frame in the world frame."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    point_m[0] = position_m[0] + cosine * x - sine * y
    point_m[1] = position_m[1] + sine * x + cosine * y
    point_m[2] = position_m[2] + z


@compiled()
def _reachable(rules: Rules, target_m: Floats, yaw_rad: float) -> bool:
    for axis in range(3):
        if not rules.workspace_low[axis] <= target_m[axis] <= rules.workspace_high[axis]:
            return False
    return rules.workspace_low[3] <= yaw_rad <= rules.workspace_high[3]


@compiled()
def footprint(
    size_m: Floats, position_m: Floats, yaw_rad: float, grow_m: float, corners_m: Floats
) -> None:
    """Writes the four corners (4, 3) of a block seen from above, grown on every side."""
    near, far = -grow_m, size_m[0] + grow_m
    side = size_m[1] / 2 + grow_m
    _to_world(near, -side, 0.0, position_m, yaw_rad, corners_m[0])
    _to_world(far, -side, 0.0, position_m, yaw_rad, corners_m[1])
    _to_world(far, side, 0.0, position_m, yaw_rad, corners_m[2])
    _to_world(near, side, 0.0, position_m, yaw_rad, corners_m[3])


@compiled()
def _apart_on_support(rules: Rules, size_m: Floats, position_m: Floats, yaw_rad: Floats) -> bool:
    """Whether all blocks stand wholly on the support, and well apart."""
    count = len(size_m)
    corners = np.empty((count, 4, 3))
    for block in range(count):
        footprint(size_m[block], position_m[block], yaw_rad[block], 0.0, corners[block])
        for corner in range(4):
            for axis in range(2):
                value = corners[block, corner, axis]
                if not rules.support_low_m[axis] <= value <= rules.support_high_m[axis]:
                    return False
        footprint(
            size_m[block], position_m[block], yaw_rad[block], BLOCK_CLEARANCE_M / 2, corners[block]
        )
        for other in range(block):
            if not (
                separated(corners[block], corners[other], yaw_rad[block])
                or separated(corners[block], corners[other], yaw_rad[other])
            ):
                return False
    return True


@compiled()
def separated(first_m: Floats, second_m: Floats, yaw_rad: float) -> bool:
    """Whether a line along or across `yaw` separates two rectangles (4, 3) seen from above."""
    for angle in (yaw_rad, yaw_rad + math.pi / 2):
        x, y = math.cos(angle), math.sin(angle)
        first_low = second_low = math.inf
        first_high = second_high = -math.inf
        for corner in range(4):
            first = first_m[corner, 0] * x + first_m[corner, 1] * y
            second = second_m[corner, 0] * x + second_m[corner, 1] * y
            first_low, first_high = min(first_low, first), max(first_high, first)
            second_low, second_high = min(second_low, second), max(second_high, second)
        if first_high < second_low or second_high < first_low:
            return True
    return False


@compiled()
def _seen(
    rules: Rules,
    size_m: Floats,
    position_m: Floats,
    yaw_rad: Floats,
    camera_m: Floats,
    camera_rotation: Floats,
    intrinsics: Floats,
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
                    x, y, depth = 0.0, 0.0, 0.0
                    for axis in range(3):
                        ray = corner[axis] - camera_m[camera, axis]
                        x += ray * camera_rotation[camera, axis, 0]
                        y += ray * camera_rotation[camera, axis, 1]
                        depth += ray * camera_rotation[camera, axis, 2]
                    if depth <= 0.0:
                        return False
                    fx, fy, cx, cy = intrinsics[camera]
                    u, v = cx + fx * x / depth, cy + fy * y / depth
                    columns, rows = rules.image_px[camera]
                    if not (0.0 <= u <= columns and 0.0 <= v <= rows):
                        return False
    return True
