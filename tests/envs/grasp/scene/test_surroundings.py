"""What stands around the blocks: that it is drawn as asked for, and is in nobody's way."""

from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
import pytest

from envs.grasp.env import make_vector_env
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import Scenes, SceneSampler, heading
from envs.grasp.scene.surroundings import (
    BACKDROP,
    BOXES,
    CABLE,
    FLOOR,
    FRAME,
    ON_TABLE,
    THINGS,
)
from envs.grasp.scene.things import SMALL_SHARE, THING_BOXES
from envs.grasp.sensors.camera import CameraPoses, project
from envs.grasp.settings import GraspSettings, Support
from envs.grasp.simulators.fast import FastSimulator

COUNT = 400
TOP_M = Support().top_m
NOTHING = {"floor": 0, "frame": 0, "wall": 0, "rack": 0, "cable": 0, "things": [0, 0]}
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def settings(surroundings: dict[str, Any] | None, **others: Any) -> GraspSettings:
    return GraspSettings.model_validate({"randomize": {"surroundings": surroundings}, **others})


def sample(
    task: GraspSettings, count: int = COUNT, seed: int = 0
) -> tuple[Scenes, dict[str, CameraPoses]]:
    return SceneSampler(task).sample(np.random.default_rng(seed), np.full(count, np.pi))


@pytest.fixture(scope="module")
def scenes() -> Scenes:
    return sample(settings({}))[0]


def used(scenes: Scenes) -> np.ndarray:
    """(n, K) where there is a box; it has three sides then."""
    there = (scenes.around_half_m > 0.0).all(-1)
    np.testing.assert_array_equal(there, (scenes.around_half_m != 0.0).any(-1))
    return there


def corners(scenes: Scenes) -> np.ndarray:
    """(n, K, 8, 3) corners of the boxes in the world."""
    local = CORNERS * scenes.around_half_m[:, :, None]
    turned = np.einsum("nkij,nkpj->nkpi", scenes.around_rotation, local)
    return turned + scenes.around_center_m[:, :, None]


def block_hull(scenes: Scenes, row: int, block: int) -> np.ndarray:
    """The footprint of a block, seen from above."""
    half, center = scenes.box_half_m[row, block], scenes.box_center_m[row, block]
    points = (center[:, None] + CORNERS * half[:, None])[half[:, 0] > 0.0].reshape(-1, 3)
    yaw = scenes.block_yaw_rad[row, block]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return hull(points[:, :2] @ turn.T + scenes.block_position_m[row, block, :2])


def hull(points: np.ndarray) -> np.ndarray:
    return cv2.convexHull(points[:, :2].astype(np.float32))


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Area in square metres that two convex outlines have in common."""
    return float(cv2.intersectConvexConvex(first, second)[0])


# -- chance ----------------------------------------------------------------------------------------


def test_blocks_cameras_and_all_later_numbers_are_those_without_surroundings() -> None:
    with_rng, without_rng = np.random.default_rng(5), np.random.default_rng(5)
    limits = np.full(50, np.pi)
    full, views = SceneSampler(settings({})).sample(with_rng, limits)
    bare, bare_views = SceneSampler(settings(None)).sample(without_rng, limits)
    assert bare.around_half_m.shape == (50, 0, 3)
    assert full.around_half_m.shape == (50, BOXES, 3)
    for name, values in bare.arrays().items():
        if not name.startswith("around_"):
            np.testing.assert_array_equal(values, full.arrays()[name])
    for name, values in bare_views["depth"].arrays().items():
        np.testing.assert_array_equal(values, views["depth"].arrays()[name])
    assert with_rng.bit_generator.state == without_rng.bit_generator.state


def test_a_seed_draws_the_same_and_another_another() -> None:
    first, again, other = (sample(settings({}), 30, seed)[0] for seed in (1, 1, 2))
    for name, values in first.arrays().items():
        np.testing.assert_array_equal(values, again.arrays()[name])
    assert (first.around_half_m != other.around_half_m).any(axis=(1, 2)).mean() > 0.9


def test_rows_differ(scenes: Scenes) -> None:
    distinct = np.unique(scenes.around_half_m[:, : FLOOR.start].reshape(COUNT, -1), axis=0)
    assert len(distinct) > 0.95 * COUNT


@pytest.mark.parametrize(
    ("chosen", "part", "boxes"),
    [
        ({"floor": 1}, FLOOR, 1),
        ({"frame": 1}, FRAME, 6),
        ({"wall": 1}, BACKDROP, 1),
        ({"rack": 1}, BACKDROP, 6),
        ({"cable": 1}, CABLE, 5),
        ({"things": [1, 1], "kinds": ["cube"]}, THINGS, 1),
        ({"things": [2, 2], "kinds": ["column"]}, THINGS, 6),
    ],
)
def test_each_part_can_be_had_alone(chosen: dict[str, Any], part: slice, boxes: int) -> None:
    there = used(sample(settings(NOTHING | chosen), 60)[0])
    assert (there[:, part].sum(axis=1) == boxes).mean() > 0.95  # few find no room
    there[:, part] = False
    assert not there.any()


def test_parts_come_as_often_as_they_should(scenes: Scenes) -> None:
    there = used(scenes)
    assert there[:, FLOOR.start].all()
    assert there[:, FRAME.start].mean() == pytest.approx(0.9, abs=0.05)
    backdrop = there[:, BACKDROP].sum(axis=1)
    assert (backdrop == 1).mean() == pytest.approx(0.4, abs=0.08)
    assert (backdrop == 6).mean() == pytest.approx(0.4, abs=0.08)
    assert there[:, CABLE.start].mean() == pytest.approx(0.5, abs=0.08)
    things = there[:, THINGS].reshape(COUNT, -1, THING_BOXES).any(-1).sum(axis=1)
    np.testing.assert_allclose(np.bincount(things) / COUNT, 1 / 3, atol=0.08)


def test_some_scenes_have_none_of_it() -> None:
    there = used(sample(settings({"present": 0.7}))[0]).any(axis=1)
    assert there.mean() == pytest.approx(0.7, abs=0.07)


def test_axes_are_rotations(scenes: Scenes) -> None:
    turn = scenes.around_rotation[used(scenes)]
    np.testing.assert_allclose(np.swapaxes(turn, 1, 2) @ turn - np.eye(3), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0)


# -- places ----------------------------------------------------------------------------------------


def test_nothing_on_the_table_overlaps_a_block_or_another_thing(scenes: Scenes) -> None:
    there, points = used(scenes), corners(scenes)
    owners = np.concatenate([np.repeat([0, 1], THING_BOXES), np.full(5, 2)])
    compared = 0
    for row in range(COUNT):
        blocks = [block_hull(scenes, row, block) for block in range(3)]
        boxes = [
            (owners[box - ON_TABLE.start], hull(points[row, box]))
            for box in range(ON_TABLE.start, ON_TABLE.stop)
            if there[row, box]
        ]
        for owner, outline in boxes:
            others = [other for theirs, other in boxes if theirs != owner]
            for other in blocks + others:
                assert overlap(outline, other) < 1e-9
                compared += 1
    assert compared > 5000


def test_the_overlap_test_sees_an_overlap(scenes: Scenes) -> None:
    block = block_hull(scenes, 0, 0)
    assert overlap(block, block + np.float32(0.01)) > 1e-3


def test_things_stand_on_the_table_and_cables_lie_on_it_or_hang_over_its_edges(
    scenes: Scenes,
) -> None:
    there, points = used(scenes), corners(scenes)
    things = points[:, THINGS].reshape(COUNT, 2, -1, 3)
    present = np.repeat(there[:, THINGS].reshape(COUNT, 2, THING_BOXES), 8, axis=-1)
    height = np.where(present, things[..., 2], np.inf)
    standing = present.any(-1)
    np.testing.assert_allclose(height.min(-1)[standing], TOP_M, atol=1e-9)
    assert np.where(present, things[..., 2], 0.0).max() <= TOP_M + 0.36
    placed = things[present]
    assert placed[:, 0].min() >= 0.88
    assert placed[:, 0].max() <= 1.50
    assert np.abs(placed[:, 1]).max() <= 0.50
    cable = points[:, CABLE][there[:, CABLE]]
    lies = np.isclose(cable[..., 2].min(-1), TOP_M)
    hangs = cable[..., 2].min(-1) < TOP_M - 0.05
    assert (lies | hangs).all()
    assert hangs.mean() == pytest.approx(0.2, abs=0.05)  # two of five boxes of every second one
    beyond = np.maximum.reduce(
        [np.abs(cable[..., 1]).min(-1) - 0.5, cable[..., 0].min(-1) - 1.5]
    )  # of all that hangs, no corner is over the table
    assert (beyond[hangs] > -1e-9).all()


def test_boxes_of_a_cable_hang_together(scenes: Scenes) -> None:
    row = used(scenes)[:, CABLE.start]
    center, half = scenes.around_center_m[row, CABLE], scenes.around_half_m[row, CABLE]
    long_axis = np.take_along_axis(
        scenes.around_rotation[row, CABLE], half.argmax(-1)[..., None, None], axis=-1
    )[..., 0]
    ends = (
        center[:, :, None]
        + np.array([[-1.0], [1.0]]) * (long_axis * half.max(-1, keepdims=True))[:, :, None]
    )
    apart = np.linalg.norm(ends[:, :, None, :, None] - ends[:, None, :, None], axis=-1)
    nearest = apart.min(axis=(3, 4))
    for box in range(1, 5):  # what hangs begins where the first that lies does
        assert (nearest[:, box, :box].min(axis=1) <= 3.0 * half.min(axis=(1, 2))).all()


def test_wall_and_rack_are_behind_the_table_by_their_distance() -> None:
    for kind in ("wall", "rack"):
        chosen = {kind: 1, "distance_m": [0.2, 0.3], "yaw_deg": [-30, 30]}
        scenes = sample(settings(NOTHING | chosen), 200)[0]
        points = corners(scenes)[:, BACKDROP][used(scenes)[:, BACKDROP]].reshape(200, -1, 3)
        ahead = scenes.around_rotation[:, BACKDROP.start, :, 0]
        yaw = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0]))
        assert np.abs(yaw).max() < 30.0
        assert np.ptp(yaw) > 40.0
        table = np.array([[x, y, 0.0] for x in (0.88, 1.5) for y in (-0.5, 0.5)])
        gap = np.einsum("npi,ni->np", points, ahead).min(1) - (ahead @ table.T).max(1)
        assert gap.min() >= 0.2 - 1e-9
        assert gap.max() <= 0.3 + 1e-9
        np.testing.assert_allclose(points[..., 2].min(), 0.0, atol=1e-9)


def test_the_frame_stands_on_the_floor_under_the_table() -> None:
    scenes = sample(settings(NOTHING | {"frame": 1}), 50)[0]
    points = corners(scenes)[:, FRAME].reshape(50, -1, 3)
    np.testing.assert_allclose(points[..., 2].min(1), 0.0, atol=1e-12)
    np.testing.assert_allclose(points[..., 2].max(1), 0.55)
    assert points[..., 0].min() >= 0.88
    assert points[..., 0].max() <= 1.5
    assert np.abs(points[..., 1]).max() <= 0.5


def test_a_support_that_reaches_the_floor_has_no_frame() -> None:
    support = {"top_m": 0.6, "thickness_m": 0.6}
    assert not used(sample(settings(NOTHING | {"frame": 1}, support=support), 5)[0]).any()


# -- what they are no part of ----------------------------------------------------------------------


def test_upright_boxes_have_a_side_no_block_has_in_every_face() -> None:
    kinds = {"things": [2, 2], "kinds": ["plate", "post", "cube", "slab"]}
    scenes = sample(settings(NOTHING | kinds))[0]
    half = scenes.around_half_m[:, THINGS][used(scenes)[:, THINGS]]
    smallest = 0.12  # of a block's face
    across = np.minimum(half[:, :2], half[:, 2:]) * 2.0
    assert across.max() <= SMALL_SHARE * smallest + 1e-12
    assert len(half) > COUNT


def test_tilted_boxes_are_tilted_and_columns_have_narrow_sides() -> None:
    tilted = sample(settings(NOTHING | {"things": [2, 2], "kinds": ["tilted"]}))[0]
    up = tilted.around_rotation[:, THINGS][used(tilted)[:, THINGS]][:, 2, 2]
    tilt = np.degrees(np.arccos(up))
    assert tilt.min() >= 20.0
    assert tilt.max() <= 45.0
    columns = sample(settings(NOTHING | {"things": [1, 1], "kinds": ["column"]}))[0]
    there = used(columns)[:, THINGS.start]
    center, half = columns.around_center_m[there, THINGS], columns.around_half_m[there, THINGS]
    np.testing.assert_allclose(center[:, 0], center[:, 1], atol=1e-12)
    # A regular hexagon: its sides are as long as its corners are far from the middle.
    np.testing.assert_allclose(2 * half[:, 0, 1], np.hypot(half[:, 0, 0], half[:, 0, 1]))
    assert 2 * half[:, 0, 1].max() <= SMALL_SHARE * 0.12


def test_beams_of_a_t_or_a_cross_are_centred_on_their_upright() -> None:
    for kind, middle in (("T", False), ("cross", True)):
        scenes = sample(settings(NOTHING | {"things": [1, 1], "kinds": [kind]}))[0]
        there = used(scenes)[:, THINGS.start]
        center, half = scenes.around_center_m[there, THINGS], scenes.around_half_m[there, THINGS]
        np.testing.assert_allclose(center[:, 0, :2], center[:, 1, :2], atol=1e-12)
        assert (half[:, 1, 1] > 2.0 * half[:, 0, 1]).all()  # an arm sticks out on either side
        upper = center[:, 0, 2] + half[:, 0, 2] - (center[:, 1, 2] + half[:, 1, 2])
        lower = center[:, 1, 2] - half[:, 1, 2] - (center[:, 0, 2] - half[:, 0, 2])
        at_an_end = np.minimum(upper, lower) < 1e-9
        assert (at_an_end != middle).all()


# -- in nobody's way -------------------------------------------------------------------------------


def test_a_perfect_first_action_touches_nothing() -> None:
    task = {"randomize": {"surroundings": {"things": [2, 2], "cable": 1}}}
    env = make_vector_env(2000, simulator="fast", workers=2, seed=3, **task)
    env.reset()
    scenes = env.scenes
    goal = scenes.target_m - 0.015 * heading(scenes.target_yaw_rad)
    actions = env.action_for(goal, scenes.target_yaw_rad)
    *_, infos = env.step_without_reset(actions)
    env.close()
    assert infos["episode_metrics"]["collision"].sum() == 0
    assert infos["episode_metrics"]["success"].all()


def test_every_camera_sees_the_whole_grasp_disc() -> None:
    cameras = {
        "depth": {"type": "depth", "width": 200, "height": 200},
        "side": {
            "type": "depth",
            "width": 200,
            "height": 200,
            "fov_deg": 60.0,
            "position_m": [0.3, -0.5, 0.9],
        },
    }
    crowded = {"things": [2, 2], "cable": 1, "kinds": ["post", "T", "cross"]}
    scenes, views = sample(settings(NOTHING | crowded, cameras=cameras), 150)
    simulator, rows = FastSimulator(150, load_robot(), Support()), np.arange(150)
    simulator.load(rows, scenes, np.tile(load_robot().home_rad, (150, 1)))
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    across = np.stack([-np.sin(scenes.target_yaw_rad), np.cos(scenes.target_yaw_rad)], -1)
    disc = np.repeat(scenes.target_m[:, None], 12, axis=1)
    disc[:, :, :2] += 0.035 * np.cos(angle)[:, None] * across[:, None]
    disc[:, :, 2] += 0.035 * np.sin(angle)
    for name in cameras:
        u, v, expected = np.moveaxis(project(views[name], disc), -1, 0)
        depth = simulator.render(rows, views[name])
        seen = depth[rows[:, None], v.astype(int), u.astype(int)]
        assert np.abs(seen - expected).max() < 0.02
    simulator.close()


def test_a_thing_before_the_face_would_hide_the_disc() -> None:
    """The same pictures, with the things moved there."""
    scenes, views = sample(settings(NOTHING | {"things": [1, 1], "kinds": ["post"]}), 20)
    moved = scenes.around_center_m.copy()
    box = THINGS.start
    moved[:, box] = (scenes.target_m + views["depth"].position_m) / 2
    scenes = scenes.with_arrays({"around_center_m": moved})
    simulator, rows = FastSimulator(20, load_robot(), Support()), np.arange(20)
    simulator.load(rows, scenes, np.tile(load_robot().home_rad, (20, 1)))
    u, v, expected = project(views["depth"], scenes.target_m[:, None])[:, 0].T
    seen = simulator.render(rows, views["depth"])[rows, v.astype(int), u.astype(int)]
    simulator.close()
    there = used(scenes)[:, box]
    assert there.sum() > 15
    assert (seen < expected - 0.1)[there].all()


def test_what_finds_no_room_is_left_out() -> None:
    small = {"x_m": [0.93, 1.45], "y_m": [-0.4, 0.4]}
    task = settings({"things": [2, 2], "kinds": ["slab"]}, blocks=4, support=small)
    scenes = sample(task, 100)[0]
    things = used(scenes)[:, THINGS].reshape(100, 2, THING_BOXES).any(-1).sum(1)
    assert things.min() < 2
    assert things.max() == 2


@pytest.mark.parametrize(
    ("surroundings", "message"),
    [
        ({"wall": 0.6, "rack": 0.5}, "sum of their probabilities is 1 at most"),
        ({"floor": 1.1}, "less than or equal to 1"),
        ({"distance_m": [-0.1, 0.2]}, "stand behind the table"),
        ({"distance_m": [0.3, 0.2]}, "a range goes from low to high"),
        ({"yaw_deg": [-50, 0]}, r"keep it within \+-45"),
        ({"cable_m": [0.0, 0.01]}, "cable_m .* must lie over 0"),
        ({"cable_m": [0.01, 0.03]}, "up to 0.02 m"),
        ({"things": [0, 3]}, "2 at most"),
        ({"things": [-1, 1]}, "0 or more"),
        ({"things": [2, 1]}, "from the fewest"),
        ({"kinds": []}, "at least 1 item"),
        ({"kinds": ["U"]}, "'T', 'cross'"),
        ({"chairs": 1.0}, "Extra inputs are not permitted"),
    ],
)
def test_surroundings_that_can_not_be_are_refused(
    surroundings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        settings(surroundings)
