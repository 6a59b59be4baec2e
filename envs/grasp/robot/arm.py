"""The robot as the task moves it: its home pose, and the motions that actions stand for.

Everything is in the world frame, with arrays of leading length N, unless said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.grasp.batch import Batch
from envs.grasp.robot.kinematics import (
    InverseKinematics,
    joint_path,
    motion_duration_s,
    tooltip_pose,
)
from envs.grasp.robot.urdf import Robot
from envs.grasp.scene.sampler import heading
from envs.grasp.settings import Workspace

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Tools(Batch):
    """N robots' tools: joints (N, 6), tooltip (N, 3), yaw (N,) and z axis (N, 3) of the tool."""

    joints_rad: Floats
    tooltip_m: Floats
    yaw_rad: Floats
    axis: Floats


class Arm:
    """The robot, as far as the task is concerned: actions to joint motions.

    Args:
        robot: with its home pose.
        workspace: what actions map onto.
        motion_checks: poses of a motion beside its last.
    """

    def __init__(self, robot: Robot, workspace: Workspace, motion_checks: int):
        self._robot, self._inverse = robot, InverseKinematics(robot)
        self._path_poses = motion_checks + 1
        ranges = (workspace.x_m, workspace.y_m, workspace.z_m, np.radians(workspace.yaw_deg))
        self._low, self._high = np.array(ranges, float).T
        self._home = tooltip_pose(robot, robot.home_rad)

    def home(self, n: int) -> Tools:
        """N robots in their home pose."""
        tooltip_m, axis = (np.tile(self._home[:3, column], (n, 1)) for column in (3, 2))
        return Tools(np.tile(self._robot.home_rad, (n, 1)), tooltip_m, np.zeros(n), axis)

    def pose(self, actions: Floats) -> tuple[Floats, Floats]:
        """Tooltip (N, 3) and yaw (N,) that actions (N, 4) in [-1, 1] stand for."""
        clipped = np.clip(actions, -1.0, 1.0)
        pose = self._low + (clipped + 1.0) / 2.0 * (self._high - self._low)
        return pose[:, :3], pose[:, 3]

    def action(self, tooltip_m: Floats, yaw_rad: Floats) -> Floats:
        """The actions (N, 4) that stand for a tooltip (N, 3) and a yaw (N,)."""
        pose = np.concatenate([tooltip_m, yaw_rad[:, None]], axis=1)
        return 2.0 * (pose - self._low) / (self._high - self._low) - 1.0

    def reach(self, start: Tools, actions: Floats) -> tuple[Tools, Floats, Floats]:
        """Where actions lead from `start`.

        Returns:
            The tools afterwards, the joint path (N, p, 6) that leads there, and its duration (N,).
        """
        tooltip, yaw = self.pose(actions)
        joints, _ = self._inverse(tooltip, yaw)
        path = joint_path(start.joints_rad, joints, self._path_poses)
        duration_s = motion_duration_s(self._robot, start.joints_rad, joints)
        return Tools(joints, tooltip, yaw, heading(yaw)), path, duration_s
