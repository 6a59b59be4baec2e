"""The physical pick: what comes of poses that are right, and of those that are not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from envs.grasp.env import make_vector_env
from envs.grasp.evaluation.pick import STEP_S, Attempt, Outcome, Picker
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.kinematics import tooltip_pose
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import Scenes, SceneSampler, heading
from envs.grasp.scene.surroundings import BOXES, FLOOR, THINGS
from envs.grasp.settings import GraspSettings, Pick, Randomize, Support, Surroundings

BuildScene = Callable[..., Scenes]
GAP_M = 0.015
FREE_M = np.array([1.0, -0.35, 0.85])
ARM = Arm.of(GraspSettings(), load_robot())
BOX = ((1.0, 0.0), 0.0, (0.1, 0.16, 0.2))


@pytest.fixture(scope="module")
def picker() -> Iterator[Picker]:
    made = Picker(ARM, Support(), Pick())
    yield made
    made.close()


def scenes_of(*shapes: Any, count: int, seed: int = 0) -> Scenes:
    settings = GraspSettings(randomize=Randomize(shapes=shapes))
    return SceneSampler(settings).sample(np.random.default_rng(seed), np.full(count, np.pi))[0]


def aim(
    scene: Scenes,
    *,
    gap: float = GAP_M,
    lateral: float = 0.0,
    vertical: float = 0.0,
    yaw_deg: float = 0.0,
) -> tuple[np.ndarray, float]:
    """Where to send the tool, by errors in the block's frame."""
    yaw = float(scene.target_yaw_rad[0])
    ahead = heading(np.array(yaw))
    sideways, up = np.array([ahead[1], -ahead[0], 0.0]), np.array([0.0, 0.0, 1.0])
    tooltip = scene.target_m[0] - gap * ahead + lateral * sideways + vertical * up
    return tooltip, yaw + np.radians(yaw_deg)


@pytest.mark.parametrize("shape", ["parallelepiped", "L", "U"])
def test_a_perfect_pose_picks_every_shape(picker: Picker, shape: str) -> None:
    scenes = scenes_of(shape, count=4)
    for row in range(4):
        scene = scenes[row : row + 1]
        assert picker.pick(scene, *aim(scene)) == Outcome.SUCCESS


def test_the_corners_of_the_last_lessons_region_are_good_enough(picker: Picker) -> None:
    scenes = scenes_of("parallelepiped", "L", "U", count=8, seed=1)
    signs = np.array(np.meshgrid(*[[-1, 1]] * 4)).reshape(4, -1).T[::2]
    for row, (lateral, vertical, gap, yaw) in enumerate(signs):
        scene = scenes[row : row + 1]
        pose = aim(
            scene,
            lateral=0.0099 * lateral * np.sqrt(0.5),  # on the disc that has room for the cup
            vertical=0.0099 * vertical * np.sqrt(0.5),
            gap=0.015 + 0.005 * gap,
            yaw_deg=1.9 * yaw,
        )
        assert picker.pick(scene, *pose) == Outcome.SUCCESS


@pytest.mark.parametrize(
    ("errors", "outcome"),
    [
        ({"lateral": 0.04}, Outcome.SUCCESS),  # the rim ends 10 mm before the edge
        ({"lateral": 0.06}, Outcome.NO_SEAL),  # and here 10 mm behind it
        ({"vertical": 0.08}, Outcome.NO_SEAL),
        ({"yaw_deg": 10.0}, Outcome.NO_SEAL),
        ({"yaw_deg": -10.0}, Outcome.NO_SEAL),
        ({"lateral": 0.13}, Outcome.MISSED),
        ({"gap": 0.07}, Outcome.MISSED),
        ({"gap": -0.02}, Outcome.COLLISION),
        ({"vertical": -0.09}, Outcome.COLLISION),  # the cup is 60 mm wide, and 10 mm above
    ],
)
def test_other_poses_fail_for_their_reason(
    picker: Picker, box_scene: BuildScene, errors: dict[str, float], outcome: Outcome
) -> None:
    scene = box_scene([BOX, ((1.3, 0.2), 0.0, (0.1, 0.1, 0.1))])
    assert picker.pick(scene, *aim(scene, **errors)) == outcome


def test_three_millimetres_are_as_far_as_a_lip_gives(picker: Picker, box_scene: BuildScene) -> None:
    # A rim of 60 mm turned by an angle a has its far side at 60 mm * sin(a): 3 mm at 2.87 deg.
    scene = box_scene([BOX])
    assert picker.pick(scene, *aim(scene, yaw_deg=2.7)) == Outcome.SUCCESS
    assert picker.pick(scene, *aim(scene, yaw_deg=3.1)) == Outcome.NO_SEAL


def test_nothing_seals_between_the_legs_of_a_u(picker: Picker) -> None:
    scene = scenes_of("U", count=1, seed=2)
    foot = scene.target_m[0, 2] - scene.block_position_m[0, 0, 2] - 0.045
    side = scene.target_m[0, :2] - scene.block_position_m[0, 0, :2]
    pose = aim(scene, lateral=float(np.linalg.norm(side)), vertical=-foot)
    assert picker.pick(scene, *pose) in (Outcome.NO_SEAL, Outcome.MISSED)


@pytest.mark.parametrize(("density", "outcome"), [(1000.0, "success"), (1400.0, "dropped")])
def test_a_block_heavier_than_the_cup_holds_is_dropped(
    box_scene: BuildScene, density: float, outcome: str
) -> None:
    # 0.5 * 60 kPa * pi * (0.03 m)^2 = 84.8 N, and at most 1.2 m/s^2 upwards: 7.7 kg.
    # The block has 6.9 litres.
    scene = box_scene([((1.05, 0.0), 0.0, (0.12, 0.24, 0.24))])
    picker = Picker(ARM, Support(), Pick(density_kg_m3=density))
    try:
        assert picker.pick(scene, *aim(scene)) == outcome
    finally:
        picker.close()


def test_the_block_hangs_where_it_was_lifted_to(picker: Picker, box_scene: BuildScene) -> None:
    scene = box_scene([BOX])
    poses: list[Any] = []

    def watch(attempt: Attempt) -> None:
        poses.append(attempt.target_pose())

    assert picker.pick(scene, *aim(scene), watch) == Outcome.SUCCESS
    heights = np.array([position[2] for position, _ in poses])
    assert heights[0] == pytest.approx(0.7, abs=1e-3)  # it stands, and does not sink or jump
    assert heights[-240:] == pytest.approx(0.9, abs=2e-3)  # one second up there
    assert poses[-1][1][3] == pytest.approx(1.0, abs=1e-3)  # upright


def test_a_pick_is_the_same_whatever_came_before(picker: Picker, box_scene: BuildScene) -> None:
    scene, other = box_scene([BOX]), scenes_of("L", count=1, seed=3)

    def course() -> list[Any]:
        poses: list[Any] = []
        picker.pick(scene, *aim(scene), lambda attempt: poses.append(attempt.target_pose()))
        return poses

    first = course()
    picker.pick(other, *aim(other, yaw_deg=20.0))
    assert course() == first


def test_what_stands_around_is_in_the_way_only_where_it_stands(
    picker: Picker, box_scene: BuildScene
) -> None:
    bare = box_scene([BOX])
    for x, outcome in ((0.92, Outcome.COLLISION), (1.3, Outcome.SUCCESS)):  # before, and behind
        center, half = np.zeros((2, 1, BOXES, 3))
        center[0, THINGS.start], half[0, THINGS.start] = (x, 0.0, 0.7), (0.01, 0.01, 0.1)
        # The base stands on the floor, and that is no contact.
        center[0, FLOOR.start], half[0, FLOOR.start] = (0.0, 0.0, -0.05), (3.0, 3.0, 0.05)
        turns = np.tile(np.eye(3), (1, BOXES, 1, 1))
        scene = bare.with_arrays(
            {"around_center_m": center, "around_half_m": half, "around_rotation": turns}
        )
        assert picker.pick(scene, *aim(scene)) == outcome


def test_a_perfect_pose_picks_among_all_that_stands_around(picker: Picker) -> None:
    around = Surroundings(things=(2, 2), cable=1.0)
    settings = GraspSettings(randomize=Randomize(surroundings=around))
    scenes, _ = SceneSampler(settings).sample(np.random.default_rng(4), np.full(12, np.pi))
    for row in range(12):
        scene = scenes[row : row + 1]
        assert picker.pick(scene, *aim(scene)) == Outcome.SUCCESS


def test_a_pose_too_near_for_a_run_up_is_driven_to_all_the_same(
    picker: Picker, box_scene: BuildScene
) -> None:
    assert picker.pick(box_scene([BOX]), np.array([0.82, 0.4, 0.7]), 0.0) == Outcome.MISSED


@pytest.mark.parametrize("simulator", ["fast", "pybullet"])
def test_the_environment_picks_without_its_episodes_noticing(simulator: str) -> None:
    env = make_vector_env(3, simulator=simulator, workers=0)
    try:
        env.reset()
        scenes = env.scenes
        tooltip = scenes.target_m - GAP_M * heading(scenes.target_yaw_rad)
        actions = env.action_for(tooltip, scenes.target_yaw_rad)
        actions[1, 3] = -np.sign(actions[1, 3])  # as wrong a yaw as there is
        before = env.state_dict()
        check = env.evaluator().physical_check()
        outcomes = check(actions[:2])
        check.close()
        check.close()
        assert check.tried_out == 2
        assert set(outcomes) == {str(outcome) for outcome in Outcome}
        np.testing.assert_array_equal(outcomes["success"], [True, False])
        np.testing.assert_array_equal(sum(rows.astype(int) for rows in outcomes.values()), [1, 1])
        np.testing.assert_equal(env.state_dict(), before)
    finally:
        env.close()


def commanded(arm: Arm, settings: Pick, scene: Scenes) -> np.ndarray:
    """Joints (n, 6) that the motors were sent to at each time step, on the way to a free pose."""
    joints, picker = [arm.robot.home_rad], Picker(arm, Support(), settings)
    picker.reach(scene, FREE_M, 0.3, lambda attempt: joints.append(attempt._joints_rad))
    picker.close()
    return np.array(joints)


@pytest.mark.parametrize(
    "options", [{}, {"standoff_m": 0.15}, {"motion": "direct"}], ids=["default", "long", "direct"]
)
@pytest.mark.parametrize("approach_s", [0.01, 0.5])
def test_no_joint_is_sent_faster_than_it_can(
    box_scene: BuildScene, options: dict[str, Any], approach_s: float
) -> None:
    arm = Arm.of(GraspSettings(**options), load_robot())
    joints = commanded(arm, Pick(approach_s=approach_s), box_scene([BOX]))
    turned = np.abs(np.diff(joints, axis=0))
    assert (turned / STEP_S <= arm.robot.max_speed_rad_s * (1.0 + 1e-9)).all()
    assert (turned > 0.0).any(axis=1).all()  # nor does it stand still
    pose = tooltip_pose(arm.robot, joints[-1])
    np.testing.assert_allclose(pose[:3, 3], FREE_M, atol=1e-9)


def test_a_slow_approach_takes_its_time(box_scene: BuildScene) -> None:
    lengths = [len(commanded(ARM, Pick(approach_s=s), box_scene([BOX]))) for s in (1.0, 2.0)]
    assert lengths[1] - lengths[0] == round(1.0 / STEP_S)
