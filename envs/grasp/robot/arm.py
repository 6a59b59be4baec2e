"""The robot as the task moves it: its home pose, and the motions that actions stand for.

Everything is in the world frame, with arrays of leading length N, unless said otherwise.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.grasp.batch import Batch
from envs.grasp.robot.approach import Approach
from envs.grasp.robot.kinematics import tooltip_pose
from envs.grasp.robot.paths import Path, duration_s, joined, leg_poses, legs, straight_leg
from envs.grasp.robot.urdf import Robot
from envs.grasp.scene.sampler import heading
from envs.grasp.settings import GraspSettings, Workspace

Floats = NDArray[np.float64]

# Poses along each of the workspace's four ranges that are looked at when an arm is made.
PROBES = 7
# Parts of a leg at which a parabola is furthest from a straight line, and how far it may be.
BETWEEN = (0.2, 0.8)
MAX_ASIDE_M = 0.001


@dataclass(frozen=True)
class Tools(Batch):
    """N robots' tools.

    Attributes:
        approach_rad: (N, k, 6) the path on which the tool came in, straight along its axis; it
            leaves on the same. At home all knots are the home pose.
        tooltip_m: (N, 3).
        yaw_rad: (N,).
        axis: (N, 3) the tool's z axis.
    """

    approach_rad: Path
    tooltip_m: Floats
    yaw_rad: Floats
    axis: Floats

    @property
    def joints_rad(self) -> Floats:
        """(N, 6) where the joints are."""
        return self.approach_rad[:, -1]


class Arm:
    """The robot, as far as the task is concerned: actions to motions.

    A motion has three legs: back along the tool's axis to behind the present pose, through joint
    space to behind the commanded one, and straight ahead to it. At home there is nothing to go back
    from.

    Args:
        robot: with its home pose.
        workspace: what actions map onto.
        standoff_m: how far behind a pose it is approached from, or as far as the joint limits
            allow; 0: a motion is one leg through joint space.

    Attributes:
        robot: what it was made with.

    Raises:
        ValueError: a pose of the workspace is out of reach, or cannot be approached straight.
    """

    def __init__(self, robot: Robot, workspace: Workspace, standoff_m: float):
        self.robot, self._approach = robot, Approach(robot, standoff_m)
        ranges = (workspace.x_m, workspace.y_m, workspace.z_m, np.radians(workspace.yaw_deg))
        self._low, self._high = np.array(ranges, float).T
        home = tooltip_pose(robot, robot.home_rad)
        self._home_tooltip_m, self._home_axis = home[:3, 3], home[:3, 2]
        self._check_reach(standoff_m)

    @classmethod
    def of(cls, settings: GraspSettings, robot: Robot) -> Arm:
        """A task's arm."""
        standoff_m = settings.standoff_m if settings.motion == "standoff" else 0.0
        return cls(robot, settings.workspace, standoff_m)

    def home(self, n: int) -> Tools:
        """N robots in their home pose."""
        knots = self._approach.knots
        return Tools(
            np.tile(self.robot.home_rad, (n, knots, 1)),
            np.tile(self._home_tooltip_m, (n, 1)),
            np.zeros(n),
            np.tile(self._home_axis, (n, 1)),
        )

    def pose(self, actions: Floats) -> tuple[Floats, Floats]:
        """Tooltip (N, 3) and yaw (N,) that actions (N, 4) in [-1, 1] stand for."""
        clipped = np.clip(actions, -1.0, 1.0)
        pose = self._low + (clipped + 1.0) / 2.0 * (self._high - self._low)
        return pose[:, :3], pose[:, 3]

    def action(self, tooltip_m: Floats, yaw_rad: Floats) -> Floats:
        """The actions (N, 4) that stand for a tooltip (N, 3) and a yaw (N,)."""
        pose = np.concatenate([tooltip_m, yaw_rad[:, None]], axis=1)
        return 2.0 * (pose - self._low) / (self._high - self._low) - 1.0

    def reach(self, start: Tools, tooltip_m: Floats, yaw_rad: Floats) -> tuple[Tools, Path, Floats]:
        """The motion to tooltips (N, 3) and yaws (N,).

        Returns:
            The tools afterwards, the path there (N, 2 k + 1, 6) from where `start` is, and its
            duration (N,) in seconds.
        """
        approach, _ = self._approach(tooltip_m, yaw_rad)
        path = joined(
            start.approach_rad[:, ::-1],
            straight_leg(start.approach_rad[:, 0], approach[:, 0]),
            approach,
        )
        tools = Tools(approach, tooltip_m, yaw_rad, heading(yaw_rad))
        return tools, path, duration_s(self.robot, path)

    def _check_reach(self, standoff_m: float) -> None:
        """Raises ValueError where the workspace is not for this arm."""
        parts = itertools.product(np.linspace(0.0, 1.0, PROBES), repeat=4)
        poses = self._low + np.array(list(parts)) * (self._high - self._low)
        approach, length_m = self._approach(poses[:, :3], poses[:, 3])
        tooltip_m = tooltip_pose(self.robot, approach[:, -1])[:, :3, 3]
        off_m = np.where(length_m < 0.0, np.linalg.norm(tooltip_m - poses[:, :3], axis=1), -1.0)
        worst = int(np.argmax(off_m))
        if off_m[worst] >= 0.0:
            x, y, z, yaw = poses[worst]
            raise ValueError(
                f"environment.workspace: {np.mean(off_m >= 0.0):.0%} of its poses are out of "
                f"reach, the worst by {1000.0 * off_m[worst]:.0f} mm (x {x:.3f} m, y {y:.3f} m, "
                f"z {z:.3f} m, yaw {np.degrees(yaw):.1f} deg): narrow its ranges; the default ones "
                "are in reach"
            )
        frames = tooltip_pose(self.robot, leg_poses(legs(approach), np.array(BETWEEN)))
        way_m = frames[..., :3, 3] - poses[:, None, None, :3]
        axis = heading(poses[:, 3])[:, None, None]
        along_m = np.sum(way_m * axis, axis=-1, keepdims=True)
        aside_m = np.linalg.norm(way_m - along_m * axis, axis=-1).max()
        if aside_m > MAX_ASIDE_M or length_m.max() < standoff_m:
            raise ValueError(
                f"environment.standoff_m {standoff_m} m leads out of where the arm moves straight: "
                f"{length_m.max():.3f} m is the longest way to a pose of the workspace, and one is "
                f"left by {1000.0 * aside_m:.1f} mm; lower it to the default 0.1, or narrow the "
                "workspace"
            )
