"""Forward and inverse kinematics in closed form, batched, exact.

The inverse holds for arms built like the KUKA KR 16: A1 vertical, A2 and A3 parallel to y, and a
spherical wrist, whose three axes meet in one point, so that position and orientation separate
(Pieper, "The kinematics of manipulators under computer control", 1968).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from envs.grasp.compiled import compiled
from envs.grasp.robot.urdf import Primitive, Robot

_AXES = ((0, 0, -1), (0, 1, 0), (0, 1, 0), (-1, 0, 0), (0, 1, 0), (-1, 0, 0))
# Below this sine of A5 the axes A4 and A6 are one line and only their sum is determined.
_SINGULAR_SINE = 1e-9
# Slack for rounding where a pose lies exactly on a limit.
_SLACK = 1e-9


def forward(robot: Robot, joints: np.ndarray) -> np.ndarray:
    """Poses of all links.

    Args:
        robot: The robot, with J joints and L links.
        joints: (..., J) joint angles in radians; limits are not enforced.

    Returns:
        (..., L, 4, 4) link frames in the world, in the order of `robot.link_names`.
    """
    joints = np.asarray(joints, dtype=np.float64)
    sine, cosine = np.sin(joints)[..., None, None], np.cos(joints)[..., None, None]
    frames = np.empty((*joints.shape[:-1], len(robot.link_names), 4, 4))
    for link, (parent, joint) in enumerate(zip(robot.link_parents, robot.link_joints, strict=True)):
        local = robot.link_origins[link]
        if joint >= 0:
            # Rodrigues: R = (1 + K K) + sin K - cos K K, with K the axis' cross-product matrix
            cross, square = _cross_matrix(robot.joint_axes[joint])
            constant = local @ (np.eye(4) + square)
            local = (
                constant
                + sine[..., joint, :, :] * (local @ cross)
                - cosine[..., joint, :, :] * (local @ square)
            )
        frames[..., link, :, :] = local if parent < 0 else frames[..., parent, :, :] @ local
    return frames


def tooltip_pose(robot: Robot, joints: np.ndarray) -> np.ndarray:
    """The tooltip's frame in the world, (..., 4, 4), for joint angles (..., J) in radians."""
    return forward(robot, joints)[..., robot.tooltip_link, :, :]


def grasp_pose(tooltip_m: np.ndarray, yaw_rad: np.ndarray) -> np.ndarray:
    """The tool's frame with the cup's face upright.

    Tool z, out of the cup, is (cos yaw, sin yaw, 0): straight forward at yaw 0. The roll about it
    is the one at all-zero joints: tool x points down, tool y to the left of the tool's direction.

    Args:
        tooltip_m: (..., 3) centre of the cup's face in the world.
        yaw_rad: (...) heading of the tool about the vertical.

    Returns:
        (..., 4, 4) frames in the world.
    """
    tooltip_m, yaw_rad = np.asarray(tooltip_m), np.asarray(yaw_rad)
    pose = np.zeros((*np.broadcast_shapes(tooltip_m.shape[:-1], yaw_rad.shape), 4, 4))
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    pose[..., 2, 0] = -1.0
    pose[..., 0, 1], pose[..., 1, 1] = -sine, cosine
    pose[..., 0, 2], pose[..., 1, 2] = cosine, sine
    pose[..., :3, 3] = tooltip_m
    pose[..., 3, 3] = 1.0
    return pose


class InverseKinematics:
    """Joint angles for poses of the tool.

    Of the up to eight solutions it takes always the same one: A1 faces the wrist, the elbow is up,
    and A5 is not positive. A forearm that slopes down to a tool held level has A5 < 0, so over the
    task's workspace the angles are continuous. At A5 = 0, where only A4 + A6 counts, A4 is 0.

    Args:
        robot: A robot built like the KR 16.

    Raises:
        ValueError: The robot is built in another way.
    """

    def __init__(self, robot: Robot):
        self._arm = arm_lengths(robot)
        self._last_link = np.linalg.inv(robot.tooltip)
        self._lower_rad, self._upper_rad = robot.lower_rad, robot.upper_rad

    def __call__(self, tooltip_m: np.ndarray, yaw_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles that bring the tool to `grasp_pose(tooltip_m, yaw_rad)`; see `of_pose`.

        Args:
            tooltip_m: (..., 3) centre of the cup's face in the world.
            yaw_rad: (...) heading of the tool about the vertical.
        """
        return self.of_pose(grasp_pose(tooltip_m, yaw_rad))

    def of_pose(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles that bring the tooltip's frame to a pose.

        Args:
            pose: (..., 4, 4) the tooltip's frame in the world.

        Returns:
            The joint angles (..., 6) in radians, always finite and within the limits, and whether
            they reach the pose (...), bool. Where they don't, they are those of the arm stretched
            or folded towards it as far as it goes, clipped to the limits.
        """
        frames = np.asarray(pose, np.float64) @ self._last_link
        joints, near_enough = np.empty((*frames.shape[:-2], 6)), np.empty(frames.shape[:-2], bool)
        _solve(self._arm, frames.reshape(-1, 4, 4), joints.reshape(-1, 6), near_enough.reshape(-1))
        within = (joints >= self._lower_rad - _SLACK) & (joints <= self._upper_rad + _SLACK)
        reached = near_enough & within.all(axis=-1)
        return np.clip(joints, self._lower_rad, self._upper_rad), reached


def shape_reach(robot: Robot) -> np.ndarray:
    """Upper bounds (S, J) in metres: how far points of shapes are from joints, whatever the angles.

    The S shapes are those of `robot.link_primitives` one after the other. Zero where the joint does
    not move the shape: turned by dq, the joint moves no point of it by more than |dq| times this.
    """
    return np.array(
        [
            _reach_from_joints(robot, link, shape)
            for link, shapes in enumerate(robot.link_primitives)
            for shape in shapes
        ]
    )


def _reach_from_joints(robot: Robot, link: int, shape: Primitive) -> np.ndarray:
    """A row (J,) of `shape_reach`."""
    reach, point, further_m = (
        np.zeros(len(robot.joint_axes)),
        shape.pose[:3, 3],
        shape.bounding_radius_m,
    )
    while link >= 0:
        if (joint := robot.link_joints[link]) >= 0:
            # From here on the point is anywhere on a ball about the joint.
            further_m += float(np.linalg.norm(point))
            reach[joint], point = further_m, np.zeros(3)
        point = robot.link_origins[link, :3, :3] @ point + robot.link_origins[link, :3, 3]
        link = robot.link_parents[link]
    return reach


class ArmLengths(NamedTuple):
    """The lengths (m) that place the wrist's centre."""

    height: float
    shoulder: float
    upper_arm: float
    forearm: float
    forearm_rise: float


def arm_lengths(robot: Robot) -> ArmLengths:
    """The lengths of a robot.

    Raises:
        ValueError: It is not built like the KR 16.
    """
    moved = [link for link, joint in enumerate(robot.link_joints) if joint >= 0]
    origins = robot.link_origins[moved]
    offsets = origins[:, :3, 3]
    # What a KR 16 has; everything else must be zero for the closed form to hold.
    free = np.zeros((6, 3), dtype=bool)
    free[[0, 1, 2, 3, 3], [2, 0, 0, 0, 2]] = True
    alike = (
        robot.joint_axes.shape == (6, 3)
        and np.allclose(robot.joint_axes, _AXES)
        and np.allclose(origins[:, :3, :3], np.eye(3))
        and np.allclose(offsets[~free], 0.0)
    )
    if not alike:
        raise ValueError(
            f"{robot.path}: the closed-form inverse needs axes and a spherical wrist as the "
            f"KR 16 has them (axes {_AXES}, A4, A5 and A6 meeting in a point)"
        )
    return ArmLengths(
        height=float(offsets[0, 2]),
        shoulder=float(offsets[1, 0]),
        upper_arm=float(offsets[2, 0]),
        forearm=float(offsets[3, 0]),
        forearm_rise=float(offsets[3, 2]),
    )


@compiled()
def _solve(
    arm: ArmLengths, frames: np.ndarray, joints: np.ndarray, near_enough: np.ndarray
) -> None:
    """Writes the joints (n, 6) that bring the last link to frames (n, 4, 4).

    `near_enough` (n,) is set where the wrist's centre is.
    """
    for row in range(len(frames)):
        near_enough[row] = solve_frame(arm, frames[row], joints[row])


@compiled()
def solve_frame(arm: ArmLengths, frame: np.ndarray, joints: np.ndarray) -> bool:
    """Writes the joints (6,) that bring the last link to a frame (4, 4).

    Returns whether they do, for all that the arm's lengths have to say; limits are not looked at.
    """
    near_enough = _place_wrist(arm, frame[:3, 3], joints)
    _turn_wrist(frame, joints)
    return near_enough


@compiled()
def within(joints: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether joints (J,) are within their limits, but for rounding."""
    for joint in range(len(joints)):
        if not lower[joint] - _SLACK <= joints[joint] <= upper[joint] + _SLACK:
            return False
    return True


@compiled()
def _place_wrist(arm: ArmLengths, centre: np.ndarray, joints: np.ndarray) -> bool:
    """Writes A1, A2, A3 for the wrist's centre (3,); False if it is too far or too near."""
    reach, rise = math.hypot(centre[0], centre[1]) - arm.shoulder, centre[2] - arm.height
    # The triangle shoulder, elbow, wrist: d^2 = u^2 + f^2 + 2 u f cos(bend)
    forearm = math.hypot(arm.forearm, arm.forearm_rise)
    cosine = (reach**2 + rise**2 - arm.upper_arm**2 - forearm**2) / (2.0 * arm.upper_arm * forearm)
    bend = math.acos(min(max(cosine, -1.0), 1.0))
    inner = math.atan2(forearm * math.sin(bend), arm.upper_arm + forearm * math.cos(bend))
    joints[0] = -math.atan2(centre[1], centre[0])
    # Angles about y count downwards from x.
    joints[1] = (math.atan2(-rise, reach) - inner + math.pi) % (2.0 * math.pi) - math.pi
    joints[2] = bend - math.atan2(-arm.forearm_rise, arm.forearm)
    return abs(cosine) <= 1.0 + _SLACK


@compiled()
def _turn_wrist(frame: np.ndarray, joints: np.ndarray) -> None:
    """Writes A4, A5, A6, with A5 <= 0, for a last link's frame (4, 4), given A1, A2 and A3.

    Seen from the forearm, Rz(-A1) Ry(A2 + A3), the frame is R = Rx(-A4) Ry(A5) Rx(-A6). Its first
    column is (cos A5, -sin A5 sin A4, -sin A5 cos A4), its first row
    (cos A5, -sin A5 sin A6, sin A5 cos A6).
    """
    c1, s1 = math.cos(joints[0]), math.sin(joints[0])
    c, s = math.cos(joints[1] + joints[2]), math.sin(joints[1] + joints[2])
    r = np.empty((3, 3))
    for column in range(3):
        x, y, z = frame[0, column], frame[1, column], frame[2, column]
        r[0, column] = c1 * c * x - s1 * c * y - s * z
        r[1, column] = s1 * x + c1 * y
        r[2, column] = c1 * s * x - s1 * s * y + c * z
    sine = math.hypot(r[1, 0], r[2, 0])
    joints[4] = -math.atan2(sine, r[0, 0])
    if sine < _SINGULAR_SINE:
        joints[3], joints[5] = 0.0, math.atan2(r[1, 2], r[1, 1])
    else:
        joints[3], joints[5] = math.atan2(r[1, 0], r[2, 0]), math.atan2(r[0, 1], -r[0, 2])


def _cross_matrix(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K with K v = axis x v, and K K, both (4, 4) with an empty last row and column."""
    x, y, z = axis
    cross = np.zeros((4, 4))
    cross[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    return cross, cross @ cross
