from __future__ import annotations

import itertools
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.grasp.robot.arm import Arm
from envs.grasp.robot.kinematics import InverseKinematics, tooltip_pose
from envs.grasp.robot.paths import leg_poses, legs
from envs.grasp.robot.urdf import load_robot
from envs.grasp.settings import GraspSettings, Workspace

ROBOT = load_robot()
INVERSE = InverseKinematics(ROBOT)
ARM = Arm(ROBOT, Workspace(), standoff_m=0.1)
DIRECT = Arm(ROBOT, Workspace(), standoff_m=0.0)
CORNERS = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=4)))
unit = st.floats(-1, 1)


def test_actions_map_linearly_onto_the_workspace() -> None:
    tooltip, yaw = ARM.pose(np.array([[-1, -1, -1, -1], [0, 0, 0, 0], [1, 1, 1, 1], [0.5] * 4]))
    np.testing.assert_allclose(
        tooltip, [[0.82, -0.45, 0.6], [1.085, 0, 0.8], [1.35, 0.45, 1.0], [1.2175, 0.225, 0.9]]
    )
    np.testing.assert_allclose(np.degrees(yaw), [-40, 0, 40, 20], atol=1e-12)


@given(st.lists(st.tuples(unit, unit, unit, unit), min_size=1, max_size=4))
def test_actions_survive_the_round_trip(rows: list[tuple[float, ...]]) -> None:
    actions = np.array(rows)
    np.testing.assert_allclose(ARM.action(*ARM.pose(actions)), actions, atol=1e-9)


def test_actions_beyond_the_workspace_are_clipped() -> None:
    far = np.array([[3.0, -7.0, 1.5, -1.1]])
    np.testing.assert_array_equal(ARM.pose(far)[0], ARM.pose(np.sign(far))[0])
    np.testing.assert_array_equal(ARM.pose(far)[1], ARM.pose(np.sign(far))[1])


def along(path: np.ndarray, parts: int = 41) -> np.ndarray:
    """Tool frames (n, k, parts, 4, 4) evenly along the legs of paths (n, 2 k + 1, 6)."""
    part = np.linspace(0.0, 1.0, parts)
    joints = np.array([[leg_poses(leg, part) for leg in legs(one)] for one in path])
    assert (joints >= ROBOT.lower_rad - 1e-9).all()
    assert (joints <= ROBOT.upper_rad + 1e-9).all()
    return tooltip_pose(ROBOT, joints)


def reached(arm: Arm, actions: np.ndarray) -> None:
    """Asserts that a motion from home keeps the limits and ends at the commanded pose."""
    home, (tooltip, yaw) = arm.home(len(actions)), arm.pose(actions)
    tools, path, duration = arm.reach(home, tooltip, yaw)
    frames = along(path, 5)
    np.testing.assert_array_equal(path[:, 0], home.joints_rad)
    frame = frames[:, -1, -1]
    np.testing.assert_allclose(frame[:, :3, 3], tooltip, atol=1e-9)
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1)
    np.testing.assert_allclose(frame[:, :3, 2], ahead, atol=1e-9)  # the cup's face is vertical
    np.testing.assert_allclose(tools.axis, ahead, atol=1e-12)
    np.testing.assert_array_equal(tools.tooltip_m, tooltip)
    np.testing.assert_array_equal(tools.joints_rad, path[:, -1])
    assert (duration > 0).all()


@pytest.mark.parametrize("arm", [ARM, DIRECT])
def test_every_corner_of_the_workspace_is_reached(arm: Arm) -> None:
    reached(arm, CORNERS)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(unit, unit, unit, unit), min_size=1, max_size=8))
def test_every_pose_of_the_workspace_is_reached(rows: list[tuple[float, ...]]) -> None:
    reached(ARM, np.array(rows))


def test_the_direct_motion_is_the_straight_way_through_joint_space() -> None:
    first, _, _ = DIRECT.reach(DIRECT.home(1), *DIRECT.pose(np.array([[0.3, -0.5, 0.2, 0.1]])))
    second, path, duration = DIRECT.reach(first, *DIRECT.pose(np.array([[-0.3, 0.5, 0.0, -0.1]])))
    turn = second.joints_rad - first.joints_rad
    shares = (path[0] - first.joints_rad) / turn
    np.testing.assert_allclose(shares, np.tile(shares[:, :1], (1, 6)), atol=1e-9)
    np.testing.assert_allclose(np.unique(shares[:, 0].round(12)), [0.0, 0.5, 1.0])
    assert duration[0] == pytest.approx(np.abs(turn / ROBOT.max_speed_rad_s).max())


def test_three_legs_back_across_and_straight_ahead() -> None:
    rng = np.random.default_rng(0)
    start, _, _ = ARM.reach(ARM.home(200), *ARM.pose(rng.uniform(-1, 1, (200, 4))))
    end, path, duration = ARM.reach(start, *ARM.pose(rng.uniform(-1, 1, (200, 4))))
    frames = along(path)
    back, across, ahead = (frames[:, leg, :, :3] for leg in range(3))
    for leg, tools, sign in ((back, start, -1.0), (ahead[:, ::-1], end, -1.0)):
        way = leg[..., 3] - tools.tooltip_m[:, None]
        far = sign * np.einsum("npi,ni->np", way, tools.axis)
        aside = np.linalg.norm(way - sign * far[..., None] * tools.axis[:, None], axis=-1)
        assert aside.max() < 5e-4  # a parabola in joint space, not quite a line
        assert (np.diff(far, axis=1) > 0).all()
        assert (np.abs(far[:, -1] - 0.1) < 1e-9).mean() > 0.9  # as far back as it should
        turned = np.arccos(np.clip(np.einsum("npi,ni->np", leg[..., 2], tools.axis), -1, 1))
        assert np.degrees(turned.max()) < 0.1
    np.testing.assert_allclose(back[:, -1], across[:, 0], atol=1e-12)
    np.testing.assert_allclose(across[:, -1], ahead[:, 0], atol=1e-12)
    # The leg across is straight in joint space.
    np.testing.assert_allclose(path[:, 3], (path[:, 2] + path[:, 4]) / 2, atol=1e-12)
    knots = np.abs(np.diff(path, axis=1)) / ROBOT.max_speed_rad_s
    np.testing.assert_allclose(duration, knots.max(axis=2).sum(axis=1))


def test_there_is_nothing_to_go_back_from_at_home() -> None:
    _, path, _ = ARM.reach(ARM.home(1), *ARM.pose(np.zeros((1, 4))))
    np.testing.assert_array_equal(path[0, :3], np.tile(ROBOT.home_rad, (3, 1)))


def test_a_standoff_is_as_far_back_as_the_joint_limits_allow() -> None:
    near = np.array([[-1.0, y, z, 0.0] for y in (-1, 0, 1) for z in (-1, 0, 1)])
    tooltip, yaw = ARM.pose(near)
    tools, path, _ = ARM.reach(ARM.home(len(near)), tooltip, yaw)
    frames = tooltip_pose(ROBOT, path[:, -3])
    back = np.einsum("ni,ni->n", tooltip - frames[:, :3, 3], tools.axis)
    assert (back < 0.0999).any()
    for one, angle, far in zip(tooltip, yaw, back, strict=True):
        # By small steps, and with the pose's own inverse.
        steps = np.arange(0.0, 0.1 + 1e-9, 1e-4)
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        _, reach = INVERSE(one - steps[:, None] * axis, np.full(len(steps), angle))
        assert far == pytest.approx(steps[reach.cumprod().astype(bool)].max(), abs=1.1e-4)


def test_longer_standoffs_have_more_legs() -> None:
    arm = Arm(ROBOT, Workspace(x_m=(1.0, 1.3), yaw_deg=(-20, 20)), standoff_m=0.25)
    tools, path, _ = arm.reach(
        arm.home(50), *arm.pose(np.random.default_rng(1).uniform(-1, 1, (50, 4)))
    )
    assert path.shape == (50, 15, 6)
    way = along(path)[:, 4:, :, :3, 3].reshape(50, -1, 3) - tools.tooltip_m[:, None]
    aside = np.cross(way, tools.axis[:, None])
    assert np.linalg.norm(aside, axis=-1).max() < 5e-4


def test_home() -> None:
    tools = ARM.home(2)
    np.testing.assert_array_equal(tools.joints_rad, [ROBOT.home_rad] * 2)
    frame = tooltip_pose(ROBOT, tools.joints_rad)
    np.testing.assert_allclose(tools.tooltip_m, frame[:, :3, 3])
    np.testing.assert_allclose(tools.axis, frame[:, :3, 2])
    np.testing.assert_array_equal(tools.yaw_rad, 0.0)


# -- mistakes --------------------------------------------------------------------------------------


def test_a_workspace_out_of_reach_is_refused_with_its_worst_pose() -> None:
    workspace = Workspace(x_m=(0.60, 1.35))
    with pytest.raises(
        ValueError, match=r"workspace: [\d.]+% .*the worst by \d+\.\d mm \(x 0\.600 m"
    ) as e:
        Arm(ROBOT, workspace, 0.1)
    assert "narrow its ranges" in str(e.value)
    # How far off, by the joints that come nearest.
    joints, reach = INVERSE(np.array([0.60, 0.0, 0.8]), np.array(0.0))
    assert not reach
    off_mm = 1000 * np.linalg.norm(tooltip_pose(ROBOT, joints)[:3, 3] - [0.60, 0.0, 0.8])
    assert off_mm > 100


def test_poses_out_of_reach_between_those_of_an_even_grid_are_refused() -> None:
    # Only straight ahead and level with the shoulder is x = 0.804 m too near; neither y = 0 nor
    # yaw = 0 is a seventh of these ranges, and z = 0.675 m is none of theirs.
    workspace = Workspace(x_m=(0.804, 1.3), y_m=(-0.375, 0.525), yaw_deg=(-35.0, 45.0))
    _, reach = INVERSE(np.array([0.804, 0.0, ROBOT.link_origins[1][2, 3]]), np.array(0.0))
    assert not reach
    with pytest.raises(ValueError, match=r"worst by 4\.\d mm \(x 0\.804 m, y 0\.000 m, z 0\.675 m"):
        Arm(ROBOT, workspace, 0.1)
    Arm(ROBOT, workspace.model_copy(update={"x_m": (0.809, 1.3)}), 0.1)


@pytest.mark.parametrize("arm", [ARM, DIRECT])
def test_a_pose_out_of_reach_is_never_said_to_be_reached(arm: Arm) -> None:
    tooltip_m, yaw_rad = np.array([[1.0, 0.0, 0.8], [0.7, 0.1, 0.8]]), np.array([0.0, 0.2])
    with pytest.raises(ValueError, match=r"^x 0\.700 m, y 0\.100 m, .*11\.5 deg is out of the arm"):
        arm.reach(arm.home(2), tooltip_m, yaw_rad)


def test_a_standoff_from_which_the_arm_cannot_move_straight_is_refused() -> None:
    with pytest.raises(ValueError, match=r"standoff_m 0\.3 m leads out .* by [\d.]+ mm; lower"):
        Arm(ROBOT, Workspace(), 0.3)


def test_a_standoff_further_than_any_pose_allows_is_refused_with_the_furthest() -> None:
    near = Workspace(x_m=(0.85, 0.86), y_m=(-0.01, 0.01), z_m=(0.6, 0.601), yaw_deg=(-1, 1))
    with pytest.raises(ValueError, match=r"standoff_m 0\.3 m is longer than") as caught:
        Arm(ROBOT, near, 0.3)
    found = re.search(r"lower it to ([\d.]+) m at most", str(caught.value))
    assert found is not None
    steps = np.arange(0.0, 0.3, 1e-3)
    tooltip_m = np.array([0.86, 0.0, 0.601]) - steps[:, None] * [1.0, 0.0, 0.0]
    _, reach = INVERSE(tooltip_m, np.zeros(len(steps)))
    assert float(found[1]) == pytest.approx(steps[reach].max(), abs=0.003)


@pytest.mark.parametrize("standoff_m", [-0.1, 1.001, 100.0, float("inf"), float("nan")])
def test_a_standoff_that_is_no_length_is_refused(standoff_m: float) -> None:
    with pytest.raises(ValueError, match=rf"standoff_m {standoff_m} m: no arm"):
        Arm(ROBOT, Workspace(), standoff_m)


def test_settings_choose_the_motion() -> None:
    actions = np.array([[0.1, 0.2, 0.3, 0.4]])
    for settings_, arm in (
        (GraspSettings(), ARM),
        (GraspSettings(motion="direct"), DIRECT),
        (GraspSettings(standoff_m=0.05), Arm(ROBOT, Workspace(), 0.05)),
    ):
        made = Arm.of(settings_, ROBOT)
        _, path, _ = made.reach(made.home(1), *made.pose(actions))
        _, expected, _ = arm.reach(arm.home(1), *arm.pose(actions))
        np.testing.assert_array_equal(path, expected)
