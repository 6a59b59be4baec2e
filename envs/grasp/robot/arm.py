"""The robot as the task moves it: its home pose, and the motions that actions stand for.

Everything is in the world frame, with arrays of leading length N, unless said otherwise.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.grasp.batch import Batch
from envs.grasp.robot.approach import Approach
from envs.grasp.robot.kinematics import arm_lengths, tooltip_pose
from envs.grasp.robot.paths import Path, duration_s, joined, leg_poses, legs, straight_leg
from envs.grasp.robot.urdf import Robot
from envs.grasp.scene.sampler import heading
from envs.grasp.settings import GraspSettings, Workspace

Floats = NDArray[np.float64]

# Poses, evenly along each of the workspace's four ranges, that are looked at when an arm is made.
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
        threads: that work out motions; None: one for each core that may be used.

    Attributes:
        robot: what it was made with.

    Raises:
        ValueError: a pose of the workspace is out of reach, or cannot be approached straight.
    """

    def __init__(
        self,
        robot: Robot,
        workspace: Workspace,
        standoff_m: float,
        threads: int | None = None,
    ):
        self.robot, self._approach = robot, Approach(robot, standoff_m, threads)
        ranges = (workspace.x_m, workspace.y_m, workspace.z_m, np.radians(workspace.yaw_deg))
        self._low, self._high = np.array(ranges, float).T
        home = tooltip_pose(robot, robot.home_rad)
        self._home_tooltip_m, self._home_axis = home[:3, 3], home[:3, 2]
        self._check_reach(standoff_m)

    @classmethod
    def of(cls, settings: GraspSettings, robot: Robot) -> Arm:
        """A task's arm."""
        standoff_m = settings.standoff_m if settings.motion == "standoff" else 0.0
        return cls(robot, settings.workspace, standoff_m, settings.threads)

    def home(self, n: int) -> Tools:
        """N robots in their home pose."""
        knots = self._approach.knots
        return Tools(
            np.tile(self.robot.home_rad, (n, knots, 1)),
            np.tile(self._home_tooltip_m, (n, 1)),
            np.zeros(n),
            np.tile(self._home_axis, (n, 1)),
        )

    def check(self, tools: Tools) -> None:
        """Refuses tools that came in on another arm's ways.

        Raises:
            ValueError: their ways have another number of knots.
        """
        knots, expected = tools.approach_rad.shape[1], self._approach.knots
        if knots != expected:
            raise ValueError(
                f"the tools came in on ways of {knots} knots, and this arm's have {expected}: "
                "environment.standoff_m or environment.motion is another than theirs"
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

        Raises:
            ValueError: a pose is out of reach.
        """
        approach, length_m = self._approach(tooltip_m, yaw_rad)
        if length_m.min() < 0.0:
            row = int(np.argmin(length_m))
            raise ValueError(
                f"{_in_words(np.append(tooltip_m[row], yaw_rad[row]))} is out of the arm's reach"
            )
        path = joined(
            start.approach_rad[:, ::-1],
            straight_leg(start.approach_rad[:, 0], approach[:, 0]),
            approach,
        )
        tools = Tools(approach, tooltip_m, yaw_rad, heading(yaw_rad))
        return tools, path, duration_s(self.robot, path)

    def _check_reach(self, standoff_m: float) -> None:
        """Raises ValueError where the workspace is not for this arm."""
        poses = self._probes()
        approach, length_m = self._approach(poses[:, :3], poses[:, 3])
        tooltip_m = tooltip_pose(self.robot, approach[:, -1])[:, :3, 3]
        off_m = np.where(length_m < 0.0, np.linalg.norm(tooltip_m - poses[:, :3], axis=1), -1.0)
        worst = int(np.argmax(off_m))
        if off_m[worst] >= 0.0:
            raise ValueError(
                f"environment.workspace: {np.mean(off_m >= 0.0):.2%} of its poses are out of "
                f"reach, the worst by {1000.0 * off_m[worst]:.1f} mm ({_in_words(poses[worst])}): "
                "narrow its ranges; the default ones are in reach"
            )
        if (longest_m := float(length_m.max())) < standoff_m:
            raise ValueError(
                f"environment.standoff_m {standoff_m} m is longer than the way to any pose of the "
                f"workspace: lower it to {math.floor(1000.0 * longest_m) / 1000.0} m at most"
            )
        aside_m = self._aside_m(poses, approach)
        if aside_m > MAX_ASIDE_M:
            raise ValueError(
                f"environment.standoff_m {standoff_m} m leads out of where the arm moves straight: "
                f"a way to a pose of the workspace is left by {1000.0 * aside_m:.1f} mm; lower it, "
                "or narrow the workspace"
            )

    def _probes(self) -> Floats:
        """Poses (n, 4), tooltip and yaw, all over the workspace, and where reach is extreme.

        The wrist is nearest to the shoulder, and furthest from it, straight ahead and level with it
        or at the ends of the ranges.
        """
        level = np.clip([np.inf, 0.0, arm_lengths(self.robot).height, 0.0], self._low, self._high)
        even = np.linspace(self._low, self._high, PROBES)
        return np.array(list(itertools.product(*np.vstack([even, level]).T)))

    def _aside_m(self, poses: Floats, approach: Path) -> float:
        """How far the tool leaves the straight ways to poses (n, 4) on paths (n, 2 k + 1, 6)."""
        frames = tooltip_pose(self.robot, leg_poses(legs(approach), np.array(BETWEEN)))
        way_m = frames[..., :3, 3] - poses[:, None, None, :3]
        axis = heading(poses[:, 3])[:, None, None]
        along_m = np.sum(way_m * axis, axis=-1, keepdims=True)
        return float(np.linalg.norm(way_m - along_m * axis, axis=-1).max())


def _in_words(pose: Floats) -> str:
    """A pose (4,), tooltip and yaw."""
    x, y, z, yaw = pose
    return f"x {x:.3f} m, y {y:.3f} m, z {z:.3f} m, yaw {np.degrees(yaw):.1f} deg"
