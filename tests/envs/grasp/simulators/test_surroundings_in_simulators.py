"""What stands around the blocks, in both simulators: pictures, contacts, and many worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pybullet
import pytest
from worlds import FIRST, RESOLUTION_M, ROBOT, fixed_views, home, pose, reaching

from benchmarks.agreement import compare
from envs.grasp.robot.paths import straight_leg
from envs.grasp.scene.sampler import Scenes, SceneSampler
from envs.grasp.scene.surroundings import BACKDROP, BOXES, CABLE, FLOOR, FRAME, THINGS
from envs.grasp.sensors.camera import CameraPoses, euler_rotations, pinhole
from envs.grasp.settings import Camera, GraspSettings, Randomize, Support, Surroundings
from envs.grasp.simulators.bodies import quaternion
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.pybullet import PyBulletSimulator
from envs.grasp.simulators.workers import ParallelSimulator

SceneBuilder = Callable[..., Scenes]
BOTH = pytest.mark.parametrize("make", [FastSimulator, PyBulletSimulator])
TARGET = ((1.30, 0.30), 0.0, (0.1, 0.15, 0.15))


def sampled(count: int, seed: int = 0) -> tuple[Scenes, dict[str, CameraPoses]]:
    settings = GraspSettings(randomize=Randomize(surroundings=Surroundings()))
    return SceneSampler(settings).sample(np.random.default_rng(seed), np.full(count, np.pi))


def with_box(
    scene: Scenes,
    number: int,
    center: tuple[float, float, float],
    half: tuple[float, float, float],
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scenes:
    """One scene with one box around, turned by angles about x, then y, then z."""
    centers, halves = np.zeros((2, 1, BOXES, 3))
    turns = np.zeros((1, BOXES, 3, 3))
    centers[0, number], halves[0, number] = center, half
    turns[0, number] = euler_rotations(np.array([turn]))[0]
    return scene.with_arrays(
        {"around_center_m": centers, "around_half_m": halves, "around_rotation": turns}
    )


def around_depth(scenes: Scenes, views: CameraPoses) -> np.ndarray:
    """Depth (n, H, W) of the boxes around alone, by rays clipped in each box's own frame."""
    camera, lens = views.camera, pinhole(views.camera)
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack(
        [(column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy, np.ones_like(row)], axis=-1
    )
    depth = np.full((len(scenes), camera.height, camera.width), np.inf)
    for i, k in np.argwhere(scenes.around_half_m[..., 0] > 0.0):
        turn, half = scenes.around_rotation[i, k], scenes.around_half_m[i, k]
        origin = (views.position_m[i] - scenes.around_center_m[i, k]) @ turn
        along = rays @ views.rotation[i].T @ turn
        with np.errstate(divide="ignore"):
            ends = np.stack([(side * half - origin) / along for side in (-1, 1)])
        enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
        hit = (enter <= leave) & (enter > 0.0)
        depth[i] = np.where(hit, np.minimum(depth[i], enter), depth[i])
    return depth


def test_both_agree_on_a_sample() -> None:
    found, _ = compare(scenes=30, motions=4, size=(80, 80), seed=2, surroundings=Surroundings())
    bare, _ = compare(scenes=30, motions=4, size=(80, 80), seed=2)
    assert found.depth >= 0.99
    assert found.all_pixels >= 0.98
    assert found.color >= 0.99
    assert found.contacts >= 0.98
    assert found.contacts_or_near == 1.0
    assert found.collided > bare.collided  # there is more to be touched


@BOTH
def test_depth_is_that_of_rays(make: Any) -> None:
    scenes, _ = sampled(10, 4)
    for camera in (
        Camera(type="depth", width=80, height=80, far_m=(9.0, 9.0)),
        # From over the base, steep and turned: the floor reaches behind the camera.
        Camera(
            type="depth",
            width=64,
            height=48,
            fov_deg=70.0,
            roll_deg=45.0,
            position_m=(0.3, 0.0, 1.2),
            target_m=(0.9, 0.0, 0.4),
            far_m=(9.0, 9.0),
        ),
    ):
        views, everyone = fixed_views(camera, 10), np.arange(10)
        simulator = make(10, ROBOT, Support())
        simulator.load(everyone, scenes, home(10))
        everything = simulator.render(everyone, views)
        nothing = np.zeros_like(scenes.around_half_m)
        simulator.load(everyone, scenes.with_arrays({"around_half_m": nothing}), home(10))
        rest = simulator.render(everyone, views)
        simulator.close()
        expected = np.minimum(around_depth(scenes, views), rest)
        expected[expected >= 9.0] = np.inf
        there = np.isfinite(expected) & np.isfinite(everything)
        assert (np.isfinite(expected) == np.isfinite(everything)).mean() > 0.99
        assert (np.abs(everything[there] - expected[there]) < 1e-3).mean() > 0.99
        assert (expected < rest - 1e-3).mean() > 0.2


@BOTH
@pytest.mark.parametrize(
    ("number", "center", "half", "collided"),
    [
        (THINGS.start, (1.0, 0.0, 0.70), (0.02, 0.02, 0.10), True),
        (CABLE.start, (1.0, 0.0, 0.70), (0.02, 0.02, 0.10), True),
        (BACKDROP.start, (1.0, 0.0, 0.70), (0.02, 0.02, 0.10), True),
        (FRAME.start, (1.0, 0.0, 0.70), (0.02, 0.02, 0.10), True),
        (THINGS.start, (1.0, 0.0, 0.64), (0.02, 0.02, 0.02), False),  # the tool passes over it
        (FLOOR.start, (0.0, 0.0, 0.025), (2.0, 2.0, 0.05), False),  # the base stands in it
    ],
)
def test_what_stands_around_collides_and_is_never_touched(
    make: Any,
    box_scene: SceneBuilder,
    *,
    number: int,
    center: tuple[float, float, float],
    half: tuple[float, float, float],
    collided: bool,
) -> None:
    scene = with_box(box_scene([TARGET]), number, center, half)
    simulator = make(1, ROBOT, Support())
    simulator.load(FIRST, scene, home(1))
    right, left = pose(0.98, -0.35, 0.76)[:, 0], pose(0.98, 0.35, 0.76)[:, 0]
    for end in (right, left):
        assert not simulator.move(FIRST, end[:, None], RESOLUTION_M).collided[0]
    contacts = simulator.move(FIRST, straight_leg(right, left), RESOLUTION_M)
    simulator.close()
    assert contacts.collided[0] == collided
    assert not contacts.touched[0]


@BOTH
def test_a_tilted_box_is_touched_where_it_is(make: Any, box_scene: SceneBuilder) -> None:
    # A beam pitched by 45 degrees: its upper end lies towards +x, 0.14 m from its middle.
    bare, turn = box_scene([TARGET]), (0.0, np.pi / 4, 0.0)
    scene = with_box(bare, THINGS.start, (1.0, 0.0, 0.75), (0.01, 0.01, 0.2), turn)
    simulator = make(1, ROBOT, Support())
    simulator.load(FIRST, scene, home(1))
    above_low, at_high = pose(0.89, 0.0, 0.89), pose(1.12, 0.0, 0.89)
    assert not simulator.move(FIRST, above_low, RESOLUTION_M).collided[0]
    assert simulator.move(FIRST, at_high, RESOLUTION_M).collided[0]
    simulator.close()


@BOTH
def test_worlds_with_and_without_surroundings_live_side_by_side(make: Any) -> None:
    scenes, views = sampled(6)
    bare = scenes.with_arrays(
        {
            "around_center_m": np.zeros((6, 0, 3)),
            "around_rotation": np.zeros((6, 0, 3, 3)),
            "around_half_m": np.zeros((6, 0, 3)),
        }
    )
    even, odd, everyone = np.array([0, 2, 4]), np.array([1, 3, 5]), np.arange(6)
    paths = reaching(scenes)

    def results(load: Callable[[Any], None]) -> list[np.ndarray]:
        simulator = make(6, ROBOT, Support())
        load(simulator)
        contacts = simulator.move(everyone, paths, RESOLUTION_M)
        found = [contacts.touched, contacts.collided, simulator.render(everyone, views["depth"])]
        simulator.close()
        return found

    def mix(simulator: Any) -> None:
        simulator.load(everyone, scenes, home(6))  # those of the odd ones must leave no trace
        simulator.load(odd, bare[odd], home(3))

    full = results(lambda simulator: simulator.load(everyone, scenes, home(6)))
    none = results(lambda simulator: simulator.load(everyone, bare, home(6)))
    for mixed, with_them, without in zip(results(mix), full, none, strict=True):
        np.testing.assert_array_equal(mixed[even], with_them[even])
        np.testing.assert_array_equal(mixed[odd], without[odd])
    assert (full[2] != none[2]).mean() > 0.1

    def grow(simulator: Any) -> None:
        simulator.load(odd, bare[odd], home(3))
        simulator.load(even, scenes[even], home(3))

    for mixed, grown in zip(results(mix), results(grow), strict=True):
        np.testing.assert_array_equal(mixed, grown)


def test_workers_carry_them() -> None:
    scenes, views = sampled(5)
    everyone, found = np.arange(5), []
    for simulator in (
        PyBulletSimulator(5, ROBOT, Support()),
        ParallelSimulator(5, 2, ROBOT, Support()),
    ):
        simulator.load(everyone, scenes, home(5))
        contacts = simulator.move(everyone, reaching(scenes), RESOLUTION_M)
        found.append((contacts.collided, simulator.render(everyone, views["depth"])))
        simulator.close()
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_quaternions_are_those_of_the_rotations() -> None:
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (100, 3))
    half_turns = np.pi * np.eye(3)  # where other formulas divide by zero
    for turn in euler_rotations(np.concatenate([angles, half_turns, np.zeros((1, 3))])):
        again = np.reshape(pybullet.getMatrixFromQuaternion(quaternion(turn)), (3, 3))
        np.testing.assert_allclose(again, turn, atol=1e-12)


def test_another_number_of_boxes_is_refused(box_scene: SceneBuilder) -> None:
    scene = with_box(box_scene([TARGET]), 0, (1.0, 0.0, 0.7), (0.1, 0.1, 0.1))
    short = scene.with_arrays(
        {name: values[:, :3] for name, values in scene.arrays().items() if "around" in name}
    )
    simulator = FastSimulator(1, ROBOT, Support())
    with pytest.raises(ValueError, match="around_half_m of the scenes has 3 boxes"):
        simulator.load(FIRST, short, home(1))
    simulator.close()
