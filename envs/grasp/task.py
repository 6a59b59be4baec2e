"""The grasp task on N robots at once: what an action does, and what is true after it.

Everything is in the world frame, with arrays of leading length N, unless said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from envs.grasp.batch import Batch
from envs.grasp.robot.kinematics import (
    InverseKinematics,
    joint_path,
    motion_duration_s,
    tooltip_pose,
)
from envs.grasp.robot.urdf import HOME_JOINTS_RAD, load_robot
from envs.grasp.scene.sampler import Scenes, heading
from envs.grasp.settings import Goal, Workspace
from envs.grasp.simulators.base import Contacts
from rewards.grasp.transition import GraspTransition

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class GoalRegion(Batch):
    """The goal regions of n environments, in their block frames: arrays (n,)."""

    lateral_limit_m: Floats
    vertical_limit_m: Floats
    gap_min_m: Floats
    gap_limit_m: Floats
    yaw_limit_deg: Floats

    @classmethod
    def like(cls, goal: Goal, n: int) -> GoalRegion:
        """The same region n times."""
        return cls(*(np.full(n, getattr(goal, field.name)) for field in fields(cls)))

    def position_is_right(self, offset_m: Floats) -> Bools:
        """Whether tooltips at (n, 3) of the block frame lie inside: (n,)."""
        lateral, vertical, gap = offset_m.T
        return np.asarray(
            (np.abs(lateral) <= self.lateral_limit_m)
            & (np.abs(vertical) <= self.vertical_limit_m)
            & (gap >= self.gap_min_m)
            & (gap <= self.gap_limit_m)
        )


def goal_middle_m(goal: Goal) -> Floats:
    """The middle (3,) of a goal region, in the block frame."""
    return np.array([0.0, 0.0, (goal.gap_min_m + goal.gap_limit_m) / 2])


@dataclass(frozen=True)
class EpisodeProgress(Batch):
    """What has happened in N running episodes; arrays (N,)."""

    steps: NDArray[np.int64]
    touched: Bools
    collided: Bools
    position_right: Bools
    rotation_right: Bools

    @classmethod
    def start(cls, n: int) -> EpisodeProgress:
        """N episodes that have just begun."""
        return cls(np.zeros(n, np.int64), *(np.zeros(n, bool) for _ in range(4)))


@dataclass(frozen=True)
class Tools(Batch):
    """N robots' tools: joints (N, 6), tooltip (N, 3), yaw (N,) and z axis (N, 3) of the tool."""

    joints_rad: Floats
    tooltip_m: Floats
    yaw_rad: Floats
    axis: Floats


class Arm:
    """The robot, as far as the task is concerned: actions to joint motions."""

    def __init__(self, workspace: Workspace, motion_checks: int):
        self._robot = load_robot()
        self._inverse = InverseKinematics(self._robot)
        self._path_poses = motion_checks + 1
        ranges = (workspace.x_m, workspace.y_m, workspace.z_m, np.radians(workspace.yaw_deg))
        self._low, self._high = np.array(ranges, float).T
        self._home = tooltip_pose(self._robot, np.array(HOME_JOINTS_RAD))

    def home(self, n: int) -> Tools:
        """N robots in their home pose."""
        tooltip_m, axis = (np.tile(self._home[:3, column], (n, 1)) for column in (3, 2))
        return Tools(np.tile(HOME_JOINTS_RAD, (n, 1)), tooltip_m, np.zeros(n), axis)

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


def block_offset(tooltip_m: Floats, target_m: Floats, target_yaw_rad: Floats) -> Floats:
    """Tooltips (n, 3) in the frames of the target blocks: lateral x, vertical y, gap z."""
    cosine, sine = np.cos(target_yaw_rad), np.sin(target_yaw_rad)
    x, y, z = (tooltip_m - target_m).T
    # The normal is (-cos, -sin, 0), the lateral axis z cross normal: (sin, -cos, 0).
    return np.stack([x * sine - y * cosine, z, -x * cosine - y * sine], axis=1)


def yaw_error(yaw_rad: Floats, target_yaw_rad: Floats) -> Floats:
    """Signed angles (n,) in [-pi, pi) from the square yaw to the tool's."""
    return np.asarray((yaw_rad - target_yaw_rad + np.pi) % (2 * np.pi) - np.pi)


@dataclass(frozen=True)
class Motion:
    """N motions: the tools before and after, the time (N,) they took, and what was touched."""

    before: Tools
    after: Tools
    duration_s: Floats
    contacts: Contacts


def judge(
    motion: Motion, scenes: Scenes, region: GoalRegion, progress: EpisodeProgress
) -> GraspTransition:
    """Puts together what is true of N motions, before N scenes with these goals."""
    before, after = motion.before, motion.after
    offset = block_offset(after.tooltip_m, scenes.target_m, scenes.target_yaw_rad)
    error = yaw_error(after.yaw_rad, scenes.target_yaw_rad)
    position_right = region.position_is_right(offset)
    return GraspTransition(
        previous_tooltip_m=before.tooltip_m,
        tooltip_m=after.tooltip_m,
        tool_axis=after.axis,
        duration_s=motion.duration_s,
        target_point_m=scenes.target_m,
        target_normal=-heading(scenes.target_yaw_rad),
        offset_m=offset,
        yaw_error_rad=error,
        touched=motion.contacts.touched,
        collided=motion.contacts.collided,
        position_right=position_right,
        rotation_right=position_right & (np.abs(error) <= np.radians(region.yaw_limit_deg)),
        touched_before=progress.touched,
        position_right_before=progress.position_right,
        rotation_right_before=progress.rotation_right,
    )


def advance(progress: EpisodeProgress, transition: GraspTransition) -> EpisodeProgress:
    """The episodes' progress after a transition."""
    return replace(
        progress,
        steps=progress.steps + 1,
        touched=progress.touched | transition.touched,
        collided=progress.collided | transition.collided,
        position_right=progress.position_right | transition.position_right,
        rotation_right=progress.rotation_right | transition.rotation_right,
    )
