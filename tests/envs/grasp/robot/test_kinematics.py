from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pybullet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.grasp.robot.kinematics import (
    InverseKinematics,
    forward,
    grasp_pose,
    shape_reach,
    tooltip_pose,
)
from envs.grasp.robot.urdf import KR16_URDF, Box, load_robot

# Tooltip x, y, z (m) and yaw (deg). Nearer than x = 0.81 m, A3 would have to fold beyond 154 deg.
LOWER = (0.81, -0.45, 0.6, -40.0)
UPPER = (1.35, 0.45, 1.0, 40.0)
ROBOT = load_robot()
INVERSE = InverseKinematics(ROBOT)


def workspace(steps: tuple[int, int, int, int]) -> np.ndarray:
    """(*steps, 4) grid of tooltip x, y, z (m), yaw (rad), corners included."""
    axes = [np.linspace(a, b, n) for a, b, n in zip(LOWER, UPPER, steps, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    grid[..., 3] = np.deg2rad(grid[..., 3])
    return grid


def random_workspace(count: int) -> np.ndarray:
    poses = np.random.default_rng(0).uniform(LOWER, UPPER, (count, 4))
    poses[:, 3] = np.deg2rad(poses[:, 3])
    return poses


class Bullet:
    """PyBullet's own forward kinematics of the same URDF."""

    def __init__(self, client: int) -> None:
        self._client = client
        self._body = pybullet.loadURDF(str(KR16_URDF), useFixedBase=True, physicsClientId=client)
        infos = [
            pybullet.getJointInfo(self._body, joint, physicsClientId=client)
            for joint in range(pybullet.getNumJoints(self._body, physicsClientId=client))
        ]
        self.links = [info[12].decode() for info in infos]
        self._moving = [info[0] for info in infos if info[2] == pybullet.JOINT_REVOLUTE]

    def frames(self, joints: np.ndarray) -> np.ndarray:
        """(links, 4, 4), the base left out."""
        for joint, angle in zip(self._moving, joints, strict=True):
            pybullet.resetJointState(self._body, joint, angle, physicsClientId=self._client)
        states = pybullet.getLinkStates(
            self._body,
            list(range(len(self.links))),
            computeForwardKinematics=True,
            physicsClientId=self._client,
        )
        frames = np.tile(np.eye(4), (len(states), 1, 1))
        for frame, state in zip(frames, states, strict=True):
            frame[:3, 3] = state[4]
            frame[:3, :3] = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))
        return frames


@pytest.fixture(scope="module")
def bullet() -> Iterator[Bullet]:
    client = pybullet.connect(pybullet.DIRECT)
    yield Bullet(client)
    pybullet.disconnect(client)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle (...) of the rotation from a to b, (..., 3, 3); exact for small angles."""
    return np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(2)


def test_arm_is_stretched_forward_at_zero() -> None:
    tip = tooltip_pose(ROBOT, np.zeros(6))
    reach = 0.26 + 0.68 + 0.67 + 0.158 + 0.12
    np.testing.assert_allclose(tip[:3, 3], [reach, 0, 0.675 - 0.035], atol=1e-12)
    np.testing.assert_allclose(tip[:3, :3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)


def test_forward_by_hand() -> None:
    # A1 = -90 deg turns left (its axis points down); A2 = -90 deg lifts the arm upright.
    tip = tooltip_pose(ROBOT, np.deg2rad([-90, -90, 0, 0, 0, 0]))
    # The forearm's step of 0.035 m, down when stretched, then points away from the base.
    np.testing.assert_allclose(
        tip[:3, 3], [0, 0.26 + 0.035, 0.675 + 0.68 + 0.67 + 0.278], atol=1e-12
    )
    np.testing.assert_allclose(tip[:3, 2], [0, 0, 1], atol=1e-12)


def test_forward_agrees_with_pybullet_for_all_links(bullet: Bullet) -> None:
    joints = np.random.default_rng(1).uniform(ROBOT.lower_rad, ROBOT.upper_rad, (1000, 6))
    order = [ROBOT.link_names.index(name) for name in bullet.links]
    frames = forward(ROBOT, joints)
    ours = frames[:, order]
    theirs = np.stack([bullet.frames(pose) for pose in joints])
    assert np.abs(ours[:, :, :3, 3] - theirs[..., :3, 3]).max() < 1e-6
    assert angle_between(ours[:, :, :3, :3], theirs[..., :3, :3]).max() < 1e-6
    assert set(bullet.links) | {"base"} == set(ROBOT.link_names)
    np.testing.assert_array_equal(frames[:, 0], np.tile(np.eye(4), (1000, 1, 1)))


def test_inverse_reaches_the_pose_in_pybullet(bullet: Bullet) -> None:
    corners = workspace((2, 2, 2, 3)).reshape(-1, 4)
    poses = np.concatenate(
        [corners, workspace((5, 5, 5, 5)).reshape(-1, 4), random_workspace(2000)]
    )
    joints, reachable = INVERSE(poses[:, :3], poses[:, 3])
    assert reachable.all()
    tooltip = bullet.links.index("tooltip")
    tips = np.stack([bullet.frames(pose)[tooltip] for pose in joints])
    assert np.abs(tips[:, :3, 3] - poses[:, :3]).max() < 1e-6
    heading = np.stack([np.cos(poses[:, 3]), np.sin(poses[:, 3]), np.zeros(len(poses))], axis=-1)
    assert np.abs(tips[:, :3, 2] - heading).max() < 1e-6
    assert np.abs(tips[:, :3, 0] - [0, 0, -1]).max() < 1e-6


def test_every_pose_of_the_workspace_is_reachable() -> None:
    poses = workspace((28, 31, 17, 33))
    joints, reachable = INVERSE(poses[..., :3], poses[..., 3])
    assert reachable.all()
    assert (joints >= ROBOT.lower_rad).all()
    assert (joints <= ROBOT.upper_rad).all()
    tips = tooltip_pose(ROBOT, joints)
    assert np.abs(tips - grasp_pose(poses[..., :3], poses[..., 3])).max() < 1e-12


def test_no_wrist_flips_between_neighbours() -> None:
    # Steps of 2 cm, 3 cm, 2.5 cm and 2.5 deg: a flip would be a jump of about 180 deg.
    poses = workspace((28, 31, 17, 33))
    joints, _ = INVERSE(poses[..., :3], poses[..., 3])
    for axis in range(4):
        assert np.rad2deg(np.abs(np.diff(joints, axis=axis)).max()) < 20.0


def test_straight_ahead_leaves_turning_axes_at_zero() -> None:
    joints, reachable = INVERSE(np.array([1.05, 0.0, 0.72]), np.array(0.0))
    assert reachable
    np.testing.assert_allclose(joints[[0, 3, 5]], 0.0, atol=1e-12)
    assert joints[1:3].sum() > 0  # the forearm slopes down, the elbow is above
    assert joints[1:3].sum() + joints[4] == pytest.approx(0.0)  # the tool is level


@settings(max_examples=200, deadline=None)
@given(
    st.tuples(
        st.floats(-1.5, 1.5),
        st.floats(-2.2, 0.5),
        st.floats(0.2, 2.6),
        st.floats(-3.0, 3.0),
        st.floats(-2.2, -0.01),
        st.floats(-3.0, 3.0),
    )
)
def test_inverse_pose_returns_the_joints_of_its_branch(joints: tuple[float, ...]) -> None:
    frames = forward(ROBOT, np.array(joints))
    wrist = frames[ROBOT.link_names.index("link_6"), :3, 3]
    facing = wrist[:2] @ [np.cos(-joints[0]), np.sin(-joints[0])]
    found, reachable = INVERSE.of_pose(frames[ROBOT.tooltip_link])
    if facing > 1e-3:
        assert reachable
        np.testing.assert_allclose(found, joints, atol=1e-6)


def test_singular_wrist_turns_a6_alone() -> None:
    joints = np.deg2rad([10, -90, 80, 25, 0, 40])
    found, reachable = INVERSE.of_pose(tooltip_pose(ROBOT, joints))
    assert reachable
    np.testing.assert_allclose(np.rad2deg(found), [10, -90, 80, 0, 0, 65], atol=1e-6)


@pytest.mark.parametrize(
    "tooltip_m",
    [(3.0, 0.0, 0.7), (0.278, 0.0, 0.7), (0.75, 0.0, 0.675), (0.538, 0.0, 0.675), (1.0, 0.0, -9.0)],
    ids=["far", "on the axis A1", "A3 past its limit", "wrist on A2", "under the floor"],
)
@pytest.mark.filterwarnings("error")
def test_unreachable_poses_are_flagged_and_finite(tooltip_m: tuple[float, ...]) -> None:
    joints, reachable = INVERSE(np.array([tooltip_m]), np.zeros(1))
    assert not reachable.any()
    assert np.isfinite(joints).all()
    assert ((joints >= ROBOT.lower_rad) & (joints <= ROBOT.upper_rad)).all()


def test_nearest_workspace_is_limited_by_a3() -> None:
    # At 0.75 m straight ahead the arm would have to fold to A3 = 158 deg.
    x = np.array([0.75, 0.80, 0.81])
    tooltip_m = np.stack([x, np.zeros(3), np.full(3, 0.675)], axis=-1)
    _, reachable = INVERSE(tooltip_m, np.zeros(3))
    np.testing.assert_array_equal(reachable, [False, False, True])


def test_far_pose_stretches_the_arm_towards_it() -> None:
    joints, _ = INVERSE(np.array([[2.5, 2.5, 0.675]]), np.deg2rad([45.0]))
    tip = tooltip_pose(ROBOT, joints)[0, :3, 3]
    assert tip[0] == pytest.approx(tip[1])
    assert np.hypot(*tip[:2]) == pytest.approx(0.26 + 0.68 + np.hypot(0.67, 0.035) + 0.278)
    assert tip[2] == pytest.approx(0.675)


def test_single_and_batched_calls_agree() -> None:
    poses = random_workspace(12).reshape(3, 4, 4)
    joints, reachable = INVERSE(poses[..., :3], poses[..., 3])
    assert joints.shape == (3, 4, 6)
    assert reachable.shape == (3, 4)
    alone, _ = INVERSE(poses[1, 2, :3], poses[1, 2, 3])
    np.testing.assert_array_equal(alone, joints[1, 2])
    assert forward(ROBOT, joints).shape == (3, 4, len(ROBOT.link_names), 4, 4)


def test_closed_form_refuses_another_build() -> None:
    origins = ROBOT.link_origins.copy()
    origins[ROBOT.link_names.index("link_5"), 0, 3] = 0.05  # the wrist is no longer spherical
    other = dataclasses.replace(ROBOT, link_origins=origins)
    with pytest.raises(ValueError, match="spherical wrist"):
        InverseKinematics(other)


def test_no_turn_moves_a_point_of_a_shape_further_than_its_reach() -> None:
    reach, rng = shape_reach(ROBOT), np.random.default_rng(0)
    joints = rng.uniform(-np.pi, np.pi, (3000, 6))
    shapes = [(link, s) for link, some in enumerate(ROBOT.link_primitives) for s in some]
    assert reach.shape == (len(shapes), 6)
    frames = forward(ROBOT, joints)
    for row, (link, shape) in enumerate(shapes):
        is_box = isinstance(shape, Box)
        half = shape.half_extents_m if is_box else [shape.radius_m, 0, shape.length_m / 2]
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * half
        points = corners @ shape.pose[:3, :3].T + shape.pose[:3, 3]
        world = points @ np.swapaxes(frames[:, link, :3, :3], 1, 2) + frames[:, link, None, :3, 3]
        for joint in range(6):
            mover = ROBOT.link_joints.index(joint)
            if mover > link:
                assert reach[row, joint] == 0.0
                continue
            origin = frames[:, mover, None, :3, 3]
            axis = frames[:, mover, :3, :3] @ ROBOT.joint_axes[joint]
            lever = np.linalg.norm(np.cross(axis[:, None], world - origin), axis=-1)
            assert lever.max() <= reach[row, joint] + 1e-9
    # The base does not move; the cup's farthest point from A1, by the lengths of the links.
    np.testing.assert_array_equal(reach[:2], 0.0)
    further = 0.26 + 0.68 + np.hypot(0.67, 0.035) + (0.158 + 0.09 + 0.015) + np.hypot(0.03, 0.015)
    assert reach[-1, 0] == pytest.approx(further)


def test_way_home_does_not_flip_the_wrist() -> None:
    poses = workspace((5, 7, 5, 7)).reshape(-1, 4)
    joints, _ = INVERSE(poses[:, :3], poses[:, 3])
    sweep = np.rad2deg(np.abs(joints - ROBOT.home_rad).max(axis=0))
    assert (sweep < 100.0).all()
