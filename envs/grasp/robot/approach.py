"""Straight ways to poses of the tool, along its own axis: a robot's last leg, and its first."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from envs.grasp.compiled import compiled
from envs.grasp.robot.kinematics import ArmLengths, arm_lengths, solve_frame, within
from envs.grasp.robot.paths import Floats, Path
from envs.grasp.robot.urdf import Robot
from envs.grasp.settings import MAX_STANDOFF_M
from envs.grasp.simulators.thread_pool import ThreadPool

# Over the default workspace, parabolas of such a length leave the straight line by 0.3 mm and 0.07
# deg at most, and by 0.03 mm on average.
LEG_M = 0.1
# Halvings of a stand-off that is out of reach: to a hundredth of a millimetre of 0.1 m.
HALVINGS = 14


class Approach:
    """Joint paths that bring the tool straight ahead to a pose, its cup's face upright.

    Args:
        robot: built like the KR 16.
        standoff_m: how far behind the pose the way begins; or as far as the joint limits allow.
        threads: that work them out; None: one for each core that may be used.

    Attributes:
        knots: of every way, 2 k + 1 for k legs.

    Raises:
        ValueError: the robot is built in another way, or the stand-off is not between 0 and
            `MAX_STANDOFF_M`.
    """

    def __init__(self, robot: Robot, standoff_m: float, threads: int | None = None):
        if not 0.0 <= standoff_m <= MAX_STANDOFF_M:
            raise ValueError(
                f"environment.standoff_m {standoff_m} m: no arm comes from so far; give over 0 and "
                f"up to {MAX_STANDOFF_M:g} m, such as the default 0.1"
            )
        self._arm, self._last_link = arm_lengths(robot), np.linalg.inv(robot.tooltip)
        self._lower_rad, self._upper_rad = robot.lower_rad, robot.upper_rad
        self._standoff_m = standoff_m
        self._threads = ThreadPool(threads)
        self.knots = 2 * max(1, math.ceil(standoff_m / LEG_M - 1e-9)) + 1

    def __call__(self, tooltip_m: Floats, yaw_rad: Floats) -> tuple[Path, Floats]:
        """Ways to poses.

        Args:
            tooltip_m: (n, 3) the centre of the cup's face in the world.
            yaw_rad: (n,) the heading of the tool about the vertical.

        Returns:
            The ways (n, 2 k + 1, 6) in radians, and their lengths (n,) in metres; negative where
            the pose itself is out of reach, and the joints are those of `InverseKinematics`.
        """
        n = len(yaw_rad)
        ways, length_m = np.empty((n, self.knots, 6)), np.empty(n)
        solve = partial(
            _solve,
            self._arm,
            self._last_link,
            self._lower_rad,
            self._upper_rad,
            np.ascontiguousarray(tooltip_m, np.float64),
            np.ascontiguousarray(yaw_rad, np.float64),
            self._standoff_m,
            ways,
            length_m,
        )
        self._threads.parallel_for(solve, n)
        return ways, length_m


@compiled(nogil=True)
def _solve(
    arm: ArmLengths,
    last_link: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    tooltip: np.ndarray,
    yaw: np.ndarray,
    standoff: float,
    ways: np.ndarray,
    length: np.ndarray,
    begin: int,
    end: int,
) -> None:
    """Writes the ways (n, k, 6) to poses and their lengths (n,), in the rows from begin to end."""
    frame, last = np.empty((4, 4)), ways.shape[1] - 1
    for row in range(begin, end):
        way, tip, angle = ways[row], tooltip[row], yaw[row]
        reached = _reach(arm, last_link, lower, upper, tip, angle, 0.0, frame, way[last])
        far = standoff if reached else 0.0
        if reached and not _reach(arm, last_link, lower, upper, tip, angle, far, frame, way[0]):
            near = 0.0
            for _ in range(HALVINGS):
                middle = (near + far) / 2.0
                if _reach(arm, last_link, lower, upper, tip, angle, middle, frame, way[0]):
                    near = middle
                else:
                    far = middle
            far = near
        length[row] = far if reached else -1.0
        for knot in range(last):
            behind = far * (1.0 - knot / last)
            _reach(arm, last_link, lower, upper, tip, angle, behind, frame, way[knot])
        for knot in range(last + 1):
            for joint in range(6):
                way[knot, joint] = min(max(way[knot, joint], lower[joint]), upper[joint])


@compiled()
def _reach(
    arm: ArmLengths,
    last_link: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    tip: np.ndarray,
    yaw: float,
    behind: float,
    frame: np.ndarray,
    joints: np.ndarray,
) -> bool:
    """Writes the joints (6,) of the tool `behind` a pose along its axis; False if out of reach.

    `frame` (4, 4) is room for the last link's: `grasp_pose` times the last link in the tool's.
    """
    cosine, sine = math.cos(yaw), math.sin(yaw)
    for column in range(4):
        x, y, z = last_link[0, column], last_link[1, column], last_link[2, column]
        frame[0, column] = cosine * z - sine * y
        frame[1, column] = sine * z + cosine * y
        frame[2, column] = -x
    frame[0, 3] += tip[0] - behind * cosine
    frame[1, 3] += tip[1] - behind * sine
    frame[2, 3] += tip[2]
    near_enough = solve_frame(arm, frame, joints)
    return near_enough and within(joints, lower, upper)
