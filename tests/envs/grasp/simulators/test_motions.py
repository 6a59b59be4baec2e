"""Contacts along whole motions: nothing depends on how finely they are looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from worlds import FIRST, RESOLUTION_M, ROBOT, home, pose

from benchmarks.agreement import Sample, contacts
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.paths import leg_poses, legs, straight_leg
from envs.grasp.scene.sampler import Scenes, heading
from envs.grasp.settings import GraspSettings, Support
from envs.grasp.simulators.base import Simulator
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.pybullet import PyBulletSimulator

SceneBuilder = Callable[..., Scenes]
TARGET = ((1.30, 0.30), 0.0, (0.1, 0.12, 0.12))
BOTH = pytest.mark.parametrize("make", [FastSimulator, PyBulletSimulator])
SMALL = (8, 8)


@pytest.fixture(scope="module")
def random_motions() -> tuple[Sample, list[np.ndarray]]:
    """500 scenes and 20 motions in each."""
    sample = Sample(500, SMALL, seed=3)
    return sample, sample.paths(20)


@pytest.fixture
def open_simulators() -> Iterator[list[Simulator]]:
    simulators: list[Simulator] = []
    yield simulators
    for simulator in simulators:
        simulator.close()


@BOTH
def test_a_wall_thinner_than_any_step_is_hit(
    make: type, open_simulators: list[Simulator], box_scene: SceneBuilder
) -> None:
    scene = box_scene([TARGET, ((1.00, 0.0), 0.0, (0.004, 0.12, 0.24))])
    simulator = make(1, ROBOT, Support())
    open_simulators.append(simulator)
    simulator.load(FIRST, scene, home(1))
    right, left = pose(1.1, -0.35, 0.7)[:, 0], pose(1.1, 0.35, 0.7)[:, 0]
    for end in (right, left):
        assert not simulator.move(FIRST, end[:, None], RESOLUTION_M).collided[0]
    for path in (straight_leg(right, left), straight_leg(left, right)):
        for resolution_m in (0.02, RESOLUTION_M, 0.001):
            assert simulator.move(FIRST, path, resolution_m).collided[0]
    over = straight_leg(pose(1.1, -0.35, 1.0)[:, 0], pose(1.1, 0.35, 1.0)[:, 0])
    assert not simulator.move(FIRST, over, RESOLUTION_M).collided[0]


@BOTH
@pytest.mark.parametrize("resolution_m", [0.0, -0.005, 0.021, float("inf"), float("nan")])
def test_a_resolution_that_is_none_is_refused(
    make: type, open_simulators: list[Simulator], box_scene: SceneBuilder, resolution_m: float
) -> None:
    simulator = make(1, ROBOT, Support())
    open_simulators.append(simulator)
    simulator.load(FIRST, box_scene([TARGET]), home(1))
    with pytest.raises(ValueError, match=r"give 1e-06 to 0\.02 m"):
        simulator.move(FIRST, pose(1.1, 0.0, 0.8), resolution_m)


@BOTH
@pytest.mark.parametrize(("gap_m", "touched"), [(0.0005, False), (-0.0005, True)])
def test_half_a_millimetre_tells_at_the_end_of_a_straight_way(
    make: type,
    open_simulators: list[Simulator],
    box_scene: SceneBuilder,
    gap_m: float,
    touched: bool,
) -> None:
    scene = box_scene([((1.10, 0.1), 0.15, (0.1, 0.2, 0.2))])
    simulator, arm = make(1, ROBOT, Support()), Arm.of(GraspSettings(), ROBOT)
    open_simulators.append(simulator)
    simulator.load(FIRST, scene, home(1))
    yaw = scene.target_yaw_rad
    tools, path, _ = arm.reach(arm.home(1), scene.target_m - gap_m * heading(yaw), yaw)
    found = simulator.move(FIRST, path, RESOLUTION_M)
    assert (found.touched[0], found.collided[0]) == (touched, False)
    # Back again, and away: the touch is part of the next motion, too.
    _, path, _ = arm.reach(tools, np.array([[0.9, 0.3, 0.9]]), np.zeros(1))
    found = simulator.move(FIRST, path, RESOLUTION_M)
    assert (found.touched[0], found.collided[0]) == (touched, False)


def test_what_lies_on_the_way_back_is_not_swept_aside(box_scene: SceneBuilder) -> None:
    # Two blocks side by side: the tool between them gets out without a touch by going back.
    scene = box_scene(
        [((1.05, 0.11), 0.0, (0.12, 0.14, 0.2)), ((1.05, -0.11), 0.0, (0.12, 0.14, 0.2))]
    )
    between, aside = np.array([[1.10, 0.0, 0.7]]), np.array([[0.95, 0.35, 0.7]])
    for motion, collided in (("standoff", False), ("direct", True)):
        arm, simulator = (
            Arm.of(GraspSettings(motion=motion, standoff_m=0.15), ROBOT),
            FastSimulator(1, ROBOT, Support()),
        )
        simulator.load(FIRST, scene, home(1))
        start, _, _ = arm.reach(arm.home(1), between, np.zeros(1))
        _, path, _ = arm.reach(start, aside, np.zeros(1))
        assert simulator.move(FIRST, path, RESOLUTION_M).collided[0] == collided
        simulator.close()


def flags(
    sample: Sample, paths: list[np.ndarray], resolution_m: float, grow_m: float = 0.0
) -> np.ndarray:
    return contacts(FastSimulator, sample, paths, grow_m, resolution_m)


def test_halving_the_resolution_changes_nothing_but_grazes(
    random_motions: tuple[Sample, list[np.ndarray]],
) -> None:
    sample, paths = random_motions
    at = {
        resolution_m: flags(sample, paths, resolution_m)
        for resolution_m in (0.005, 0.0025, 0.00125)
    }
    assert len(at[0.005]) == 10_000
    assert 0.05 < at[0.005][:, 0].mean() < 0.5
    assert 0.2 < at[0.005][:, 1].mean() < 0.7
    for resolution_m in (0.005, 0.0025):
        rates, finer = at[resolution_m].mean(axis=0), at[resolution_m / 2].mean(axis=0)
        assert (np.abs(rates - finer) <= 0.002).all()
    # What a coarse look misses is gone when the boxes are smaller by the resolution.
    finest = flags(sample, paths, 0.0001)
    for resolution_m, found in at.items():
        assert (flags(sample, paths, 0.0001, -resolution_m) <= found).all()
        assert (found <= flags(sample, paths, 0.0001, 1e-6)).all()
        assert (found != finest).any(axis=1).mean() < 0.005


def test_no_single_pose_of_a_motion_touches_more_than_the_motion() -> None:
    sample = Sample(40, SMALL, seed=5)
    everywhere, (path,) = sample.everywhere, sample.paths(1)
    simulator = FastSimulator(len(everywhere), ROBOT, Support())
    simulator.load(everywhere, sample.scenes, path[:, 0])
    whole = simulator.move(everywhere, path, 0.001)
    touched, collided = np.zeros(40, bool), np.zeros(40, bool)
    for leg in np.moveaxis(legs(path), 1, 0):
        for joints in np.moveaxis(leg_poses(leg, np.linspace(0.0, 1.0, 401)), 1, 0):
            found = simulator.move(everywhere, joints[:, None], 0.001)
            touched |= found.touched
            collided |= found.collided
    simulator.close()
    np.testing.assert_array_equal(whole.touched, touched)
    np.testing.assert_array_equal(whole.collided, collided)
    assert 2 < collided.sum() < 38


@BOTH
def test_perfect_poses_are_reached_without_a_touch(
    make: type, open_simulators: list[Simulator]
) -> None:
    count = 300 if make is FastSimulator else 30
    sample = Sample(count, SMALL, seed=7)
    yaw, everywhere = sample.scenes.target_yaw_rad, sample.everywhere
    goal_m = sample.scenes.target_m - 0.015 * heading(yaw)
    simulator = make(count, ROBOT, Support())
    open_simulators.append(simulator)
    touched = {}
    for motion in ("standoff", "direct"):
        arm = Arm.of(GraspSettings(motion=motion), ROBOT)
        _, path, _ = arm.reach(arm.home(count), goal_m, yaw)
        simulator.load(everywhere, sample.scenes, home(count))
        found = simulator.move(everywhere, path, 0.001)
        touched[motion] = (found.touched | found.collided).mean()
    assert touched["standoff"] == 0.0
    assert touched["direct"] > 0.9  # swept through the target from above
