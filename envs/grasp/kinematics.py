"""Forward and inverse kinematics in closed form, batched, exact.

The inverse holds for arms built like the KUKA KR 16: A1 vertical, A2 and A3 parallel to y, and a
spherical wrist, whose three axes meet in one point, so that position and orientation separate
(Pieper, "The kinematics of manipulators under computer control", 1968).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envs.grasp.robot import Robot

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


def inverse(
    robot: Robot, tooltip_m: np.ndarray, yaw_rad: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles that bring the tool to `grasp_pose(tooltip_m, yaw_rad)`.

    Args:
        robot: A robot built like the KR 16.
        tooltip_m: (..., 3) centre of the cup's face in the world.
        yaw_rad: (...) heading of the tool about the vertical.

    Returns:
        As `inverse_pose`.

    Raises:
        ValueError: The robot is built in another way.
    """
    return inverse_pose(robot, grasp_pose(tooltip_m, yaw_rad))


def inverse_pose(robot: Robot, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles that bring the tooltip's frame to a pose.

    Of the up to eight solutions it takes always the same one: A1 faces the wrist, the elbow is up,
    and A5 is not positive. A forearm that slopes down to a tool held level has A5 < 0, so over the
    task's workspace the angles are continuous. At A5 = 0, where only A4 + A6 counts, A4 is 0.

    Args:
        robot: A robot built like the KR 16.
        pose: (..., 4, 4) the tooltip's frame in the world.

    Returns:
        The joint angles (..., 6) in radians, always finite and within the limits, and whether they
        reach the pose (...), bool. Where they don't, they are those of the arm stretched or folded
        towards it as far as it goes, clipped to the limits.

    Raises:
        ValueError: The robot is built in another way.
    """
    arm = _Arm.of(robot)
    pose = np.asarray(pose, dtype=np.float64)
    last_link = pose @ np.linalg.inv(robot.tooltip)
    a1, a2, a3, attainable = arm.place_wrist(last_link[..., :3, 3])
    wrist = np.swapaxes(_forearm_rotation(a1, a2 + a3), -1, -2) @ last_link[..., :3, :3]
    joints = np.stack([a1, a2, a3, *_turn_wrist(wrist)], axis=-1)
    within = (joints >= robot.lower_rad - _SLACK) & (joints <= robot.upper_rad + _SLACK)
    return np.clip(joints, robot.lower_rad, robot.upper_rad), attainable & within.all(axis=-1)


def joint_path(start: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    """Evenly spaced joint angles on the straight way through joint space.

    Args:
        start: (..., J) angles in radians, not part of the path.
        end: (..., J) angles in radians, the path's last.
        count: Number of poses, at least 1.

    Returns:
        (..., count, J) angles in radians.

    Raises:
        ValueError: `count` is less than 1.
    """
    if count < 1:
        raise ValueError(f"a path needs at least 1 pose, not {count}")
    part = (np.arange(1, count + 1) / count)[:, None]
    start, end = np.asarray(start)[..., None, :], np.asarray(end)[..., None, :]
    return start * (1.0 - part) + end * part


def motion_duration_s(robot: Robot, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Time (...) of a motion from `start` to `end`, both (..., J) in radians.

    The slowest joint moves at its largest speed, the others keep pace with it. Acceleration is
    left out.
    """
    return np.max(np.abs(np.asarray(end) - np.asarray(start)) / robot.max_speed_rad_s, axis=-1)


@dataclass(frozen=True)
class _Arm:
    """The lengths (m) that place the wrist's centre."""

    height: float
    shoulder: float
    upper_arm: float
    forearm: float
    forearm_rise: float

    @classmethod
    def of(cls, robot: Robot) -> _Arm:
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
        return cls(
            height=float(offsets[0, 2]),
            shoulder=float(offsets[1, 0]),
            upper_arm=float(offsets[2, 0]),
            forearm=float(offsets[3, 0]),
            forearm_rise=float(offsets[3, 2]),
        )

    def place_wrist(
        self, centre: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A1, A2, A3 (rad) for the wrist's centre (..., 3), and whether it is near enough."""
        x, y, z = np.moveaxis(centre, -1, 0)
        reach, rise = np.hypot(x, y) - self.shoulder, z - self.height
        # The triangle shoulder, elbow, wrist: d^2 = u^2 + f^2 + 2 u f cos(bend)
        forearm = np.hypot(self.forearm, self.forearm_rise)
        cosine = (reach**2 + rise**2 - self.upper_arm**2 - forearm**2) / (
            2.0 * self.upper_arm * forearm
        )
        bend = np.arccos(np.clip(cosine, -1.0, 1.0))
        # Angles about y count downwards from x.
        a3 = bend - np.arctan2(-self.forearm_rise, self.forearm)
        inner = np.arctan2(forearm * np.sin(bend), self.upper_arm + forearm * np.cos(bend))
        a2 = _wrapped(np.arctan2(-rise, reach) - inner)
        return -np.arctan2(y, x), a2, a3, np.abs(cosine) <= 1.0 + _SLACK


def _turn_wrist(rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A4, A5, A6 (rad) from R = Rx(-A4) Ry(A5) Rx(-A6), (..., 3, 3), with A5 <= 0.

    Its first column is (cos A5, -sin A5 sin A4, -sin A5 cos A4), its first row
    (cos A5, -sin A5 sin A6, sin A5 cos A6).
    """
    sine = np.hypot(rotation[..., 1, 0], rotation[..., 2, 0])
    singular = sine < _SINGULAR_SINE
    a4 = np.where(singular, 0.0, np.arctan2(rotation[..., 1, 0], rotation[..., 2, 0]))
    a5 = -np.arctan2(sine, rotation[..., 0, 0])
    a6 = np.where(
        singular,
        np.arctan2(rotation[..., 1, 2], rotation[..., 1, 1]),
        np.arctan2(rotation[..., 0, 1], -rotation[..., 0, 2]),
    )
    return a4, a5, a6


def _forearm_rotation(a1: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Rz(-a1) Ry(pitch), (..., 3, 3)."""
    c1, s1, c, s = np.cos(a1), np.sin(a1), np.cos(pitch), np.sin(pitch)
    rows = [[c1 * c, s1, c1 * s], [-s1 * c, c1, -s1 * s], [-s, np.zeros_like(s), c]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _cross_matrix(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K with K v = axis x v, and K K, both (4, 4) with an empty last row and column."""
    x, y, z = axis
    cross = np.zeros((4, 4))
    cross[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    return cross, cross @ cross


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angle in [-pi, pi)."""
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
