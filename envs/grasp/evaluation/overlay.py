"""The goal and a commanded pose, as lines over what a camera saw."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from encoders.spaces import DepthImage, RgbImage
from envs.drawing import captioned
from envs.grasp.evaluation.pose_commands import PoseCommands
from envs.grasp.evaluation.pose_errors import errors_of
from envs.grasp.scene.sampler import Scenes, heading
from envs.grasp.sensors.camera import CameraPoses, project
from envs.grasp.task import GoalRegion

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

STEM_M = 0.08
RIM_POINTS = 48
COLUMNS, TILES, TILE_PX = 3, 6, 240
FRACTION_BITS = 4
"""Of pixels' coordinates, as OpenCV takes them."""
GOAL_COLOR, COMMAND_COLOR, HALO = (255, 255, 255), (255, 0, 255), (0, 0, 0)


def goal_pose(scene: Scenes, region: GoalRegion) -> tuple[Floats, float]:
    """The tooltip (3,) in the middle of the goal region of one scene, world frame, and its yaw."""
    yaw_rad = float(scene.target_yaw_rad[0])
    sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
    lateral, vertical, gap = region.middle_m[0]
    offset_m = np.array([sine * lateral - cosine * gap, -cosine * lateral - sine * gap, vertical])
    return scene.target_m[0] + offset_m, yaw_rad


def cup_lines(tooltip_m: Floats, yaw_rad: float, radius_m: float) -> tuple[Floats, Floats]:
    """The cup's rim (k, 3), and its axis (2, 3) back towards the robot."""
    angle = np.linspace(0.0, 2.0 * math.pi, RIM_POINTS)[:, None]
    ahead, up = heading(np.array(yaw_rad)), np.array([0.0, 0.0, 1.0])
    rim = tooltip_m + radius_m * (np.cos(angle) * np.cross(up, ahead) + np.sin(angle) * up)
    return rim, np.stack([tooltip_m, tooltip_m - STEM_M * ahead])


def sheet(
    commands: PoseCommands, camera: str, space: DepthImage | RgbImage, cup_radius_m: float
) -> Picture:
    """What a camera saw before the first commands: the goal in white, the command in magenta.

    Args:
        commands: one or more.
        camera: its name.
        space: of its images.
        cup_radius_m: of the cup's rim.
    """
    errors = errors_of(commands, {})
    tiles = []
    for row in range(min(len(commands), TILES)):
        one = slice(row, row + 1)
        poses = (
            (*goal_pose(commands.scenes[one], commands.region[one]), GOAL_COLOR),
            (commands.tooltip_m[row], float(commands.yaw_rad[row]), COMMAND_COLOR),
        )
        lines = [
            (line, color)
            for tooltip_m, yaw_rad, color in poses
            for line in cup_lines(tooltip_m, yaw_rad, cup_radius_m)
        ]
        picture = space.picture(commands.images[camera][row])
        drawn = _drawn(picture, commands.views[camera][one], lines)
        tiles.append(captioned(drawn, errors[one].caption))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = (tiles[begin : begin + COLUMNS] for begin in range(0, len(tiles), COLUMNS))
    return np.vstack([np.hstack(row) for row in rows])


def _drawn(
    picture: Picture, view: CameraPoses, lines: list[tuple[Floats, tuple[int, int, int]]]
) -> Picture:
    """A picture (rows, columns, 3), enlarged, with lines (k, 3) of the world in it."""
    scale = TILE_PX / picture.shape[1]
    canvas = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    for points, color in lines:
        pixels = project(view, points[None])[0, :, :2] * scale
        corners = np.rint(pixels * 2.0**FRACTION_BITS).astype(np.int32)
        for ink, thickness in ((HALO, 4), (color, 2)):
            cv2.polylines(canvas, [corners], False, ink, thickness, cv2.LINE_AA, FRACTION_BITS)
    return np.asarray(canvas, np.uint8)
