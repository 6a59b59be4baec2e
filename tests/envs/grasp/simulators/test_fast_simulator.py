from __future__ import annotations

import math
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import FIRST, RESOLUTION_M, ROBOT, fixed_views, home, pose, reaching, sampled

from benchmarks.agreement import compare, difference, off_edges
from encoders.spaces import DepthImage
from envs.grasp.env import make_vector_env
from envs.grasp.robot.kinematics import forward
from envs.grasp.robot.paths import straight_leg
from envs.grasp.robot.urdf import Box
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses, pinhole, sample_views, sampling
from envs.grasp.sensors.noise import fill_normals
from envs.grasp.settings import Camera, GraspSettings, Support
from envs.grasp.simulators.factory import make_simulator
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.kernels.pairs import (
    boxes_meet,
    cylinder_meets_box,
    gap_between,
    make_pair,
)
from envs.grasp.simulators.pybullet import PyBulletSimulator
from envs.grasp.simulators.thread_pool import ThreadPool
from envs.grasp.threefry import threefry

ROOT = Path(__file__).parents[4]
SceneBuilder = Callable[..., Scenes]
SimulatorMaker = Callable[..., FastSimulator | PyBulletSimulator]
ASIDE = ((1.35, -0.38), 0.0, (0.1, 0.15, 0.15))


def loaded(scenes: Scenes, threads: int | None = None) -> FastSimulator:
    simulator = FastSimulator(len(scenes), ROBOT, Support(), threads)
    simulator.load(np.arange(len(scenes)), scenes, home(len(scenes)))
    return simulator


# -- the same world as PyBullet's ------------------------------------------------------------------


def test_it_agrees_with_pybullet_on_a_sample() -> None:
    found, (_, depth) = compare(scenes=40, motions=5, size=(80, 80), seed=1)
    assert found.off_edges > 0.7
    assert found.depth >= 0.99
    assert found.all_pixels >= 0.99
    assert found.color >= 0.99
    assert found.contacts >= 0.985  # of 200 motions; the benchmark asks 99.5 % of 10,000
    assert found.contacts_or_near == 1.0
    assert 0.02 < found.touched < 0.9
    assert 0.1 < found.collided < 0.9
    assert (depth < 0.8).mean() > 0.02  # the robot is in view


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 3), (120, 50), (41, 67), (5, 200)])
def test_pictures_of_any_size_agree(width: int, height: int) -> None:
    cameras = {kind: Camera(type=kind, width=width, height=height) for kind in ("depth", "rgb")}
    # In a handful of pixels no neighbour tells where an edge is: some of many scenes' are on one.
    count, least = (3, 0.99) if width * height > 100 else (50, 0.8)
    everyone, (scenes, _) = np.arange(count), sampled(count)
    path, fast, exact = reaching(scenes), loaded(scenes), PyBulletSimulator(count, ROBOT, Support())
    exact.load(everyone, scenes, home(count))
    for simulator in (fast, exact):
        simulator.move(everyone, path, RESOLUTION_M)
    depths, colors = (
        [s.render(everyone, fixed_views(camera, count)) for s in (exact, fast)]
        for camera in cameras.values()
    )
    exact.close()
    assert depths[1].shape == (count, height, width)
    assert depths[1].dtype == np.float32
    assert colors[1].shape == (count, height, width, 3)
    assert colors[1].dtype == np.uint8
    compared = off_edges(depths[0]) & off_edges(depths[1])
    assert (difference(*depths)[compared] < 1e-3).mean() > least
    assert (np.abs(colors[0].astype(int) - colors[1])[compared] <= 2).mean() > least


@pytest.mark.parametrize(
    ("position", "near"),
    [
        ((1.10, 0.0, 0.7), 0.05),  # in the middle of a block
        ((0.99, 0.0, 0.7), 0.05),  # the near plane cuts its face
        ((0.97, 0.0, 0.7), 0.05),
        ((1.0, 0.30, 0.58), 0.01),  # in the table
        ((0.7, 0.0, 0.601), 0.01),  # almost in the plane of its top
        ((0.0, 0.0, 0.26), 0.05),  # in the robot's base
    ],
)
def test_what_the_camera_is_in_is_seen_through(
    box_scene: SceneBuilder, position: tuple[float, float, float], near: float
) -> None:
    scene = box_scene([((1.0, 0.0), 0.1, (0.2, 0.2, 0.2)), ((1.3, 0.1), 0.4, (0.1, 0.2, 0.24))])
    camera = Camera(
        type="depth", position_m=position, target_m=(1.4, 0.05, 0.68), near_m=(near, near)
    )
    fast, exact = loaded(scene), PyBulletSimulator(1, ROBOT, Support())
    exact.load(FIRST, scene, home(1))
    depths = [simulator.render(FIRST, fixed_views(camera)) for simulator in (exact, fast)]
    exact.close()
    assert np.isfinite(depths[1]).any()
    # TinyRenderer cuts what the near plane cuts to one pixel.
    compared = off_edges(depths[0]) & off_edges(depths[1])
    assert compared.mean() > 0.3
    assert (difference(*depths)[compared] < 1e-3).mean() > 0.99


@pytest.mark.parametrize("make", [FastSimulator, PyBulletSimulator])
def test_a_sampled_picture_has_the_pixels_of_the_whole_one(make: SimulatorMaker) -> None:
    intrinsics = {"fx": 150.0, "fy": 120.0, "cx": 70.0, "cy": 63.0}
    whole = {"type": "depth", "width": 150, "height": 120, "intrinsics": intrinsics}
    part = whole | {"sampling": {"crop": [8, 5, 130, 110], "every": 3}}
    cameras = {name: Camera.model_validate(c) for name, c in (("whole", whole), ("part", part))}
    scenes, views = sampled(2, whole=cameras["part"])
    everyone, view = np.arange(2), views["whole"]
    simulator = make(2, ROBOT, Support())
    simulator.load(everyone, scenes, home(2))
    pictures = {
        name: simulator.render(
            everyone,
            replace(view, camera=camera, intrinsics=fixed_views(camera, 2).intrinsics),
        )
        for name, camera in cameras.items()
    }
    simulator.close()
    expected = sampling(cameras["part"]).take(pictures["whole"])
    assert pictures["part"].shape == expected.shape == (2, 37, 44)
    close = np.isclose(pictures["part"], expected, atol=2e-5)
    assert close.mean() > 0.999  # but for a pixel on an edge


# -- pictures, from the geometry alone -------------------------------------------------------------


def distances(points: np.ndarray, scenes: Scenes, row: int, joints: np.ndarray) -> np.ndarray:
    """Signed distances (k, shapes) of points (k, 3) to everything in a world."""
    support, found = Support(), []
    (x0, x1), (y0, y1) = support.x_m, support.y_m
    z0, z1 = support.top_m - support.thickness_m, support.top_m
    table = np.eye(4)
    table[:3, 3] = [(x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2]
    boxes = [(table, np.array([x1 - x0, y1 - y0, z1 - z0]) / 2)]
    for block in range(scenes.box_half_m.shape[1]):
        yaw, frame = scenes.block_yaw_rad[row, block], np.eye(4)
        frame[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        frame[:3, 3] = scenes.block_position_m[row, block]
        for center, half in zip(
            scenes.box_center_m[row, block], scenes.box_half_m[row, block], strict=True
        ):
            if half.all():
                moved = np.eye(4)
                moved[:3, 3] = center
                boxes.append((frame @ moved, half))
    cylinders = []
    for frame, shapes in zip(forward(ROBOT, joints), ROBOT.link_primitives, strict=True):
        for shape in shapes:
            if isinstance(shape, Box):
                boxes.append((frame @ shape.pose, shape.half_extents_m))
            else:
                size = np.array([shape.radius_m, shape.length_m / 2])
                cylinders.append((frame @ shape.pose, size))
    for frame, half in boxes:
        found.append(np.abs((points - frame[:3, 3]) @ frame[:3, :3]) - half)
    beyond = [(b, b.max(axis=1)) for b in found]
    for frame, size in cylinders:
        local = (points - frame[:3, 3]) @ frame[:3, :3]
        flat = np.stack([np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])], axis=1) - size
        beyond.append((flat, flat.max(axis=1)))
    outside = [np.linalg.norm(np.maximum(b, 0.0), axis=1) for b, _ in beyond]
    return np.stack(
        [out + np.minimum(most, 0.0) for out, (_, most) in zip(outside, beyond, strict=True)],
        axis=1,
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_seen_point_lies_on_a_surface_and_nothing_lies_before_it(seed: int) -> None:
    camera = Camera(type="depth", width=61, height=47, near_m=(0.02, 0.02), far_m=(9.0, 9.0))
    scenes, _ = sampled(1, seed)
    path, simulator = reaching(scenes, seed), loaded(scenes)
    simulator.move(FIRST, path, RESOLUTION_M)
    near_tool = scenes.target_m[0] + [-0.2, (0.3, 0.15, 0.2)[seed], 0.1 + 0.1 * seed]
    camera = camera.model_copy(
        update={"position_m": tuple(near_tool), "target_m": tuple(scenes.target_m[0])}
    )
    views = sample_views(camera, np.random.default_rng(seed), 1, 0.02, 20.0)
    depth = simulator.render(FIRST, views)[0].astype(float)
    row, column = np.nonzero(np.isfinite(depth))
    focal = pinhole(camera).fx
    rays = np.stack(
        [(column + 0.5 - 61 / 2) / focal, (row + 0.5 - 47 / 2) / focal, np.ones(len(row))], axis=1
    )
    rays = rays @ views.rotation[0].T
    eye, joints = views.position_m[0], path[0, -1]
    inside = distances(eye[None], scenes, 0, joints)[0] < 0.0
    assert not inside.any()
    points = eye + depth[row, column][:, None] * rays
    apart = distances(points, scenes, 0, joints)
    np.testing.assert_allclose(apart.min(axis=1), 0.0, atol=2e-5)
    seen = apart.argmin(axis=1)
    assert (seen == 0).any()  # the table
    assert (seen >= apart.shape[1] - 3).any()  # the tool's cylinders
    assert len(np.unique(seen)) >= 4
    for part in np.linspace(0.03, 0.999, 30):
        before = eye + (part * depth[row, column])[:, None] * rays
        assert distances(before, scenes, 0, joints).min() > -2e-5


def test_nothing_is_seen_beyond_the_far_plane() -> None:
    scenes, _ = sampled(2)
    simulator = loaded(scenes)
    everything = simulator.render(
        np.arange(2), fixed_views(Camera(type="depth", far_m=(9.0, 9.0)), 2)
    )
    near = simulator.render(np.arange(2), fixed_views(Camera(type="depth", far_m=(0.95, 0.95)), 2))
    assert (everything > 0.95).mean() > 0.1
    cut = np.where(everything <= 0.95, everything, np.inf)
    np.testing.assert_allclose(near, cut, rtol=1e-6)


def test_color_is_the_blocks_times_the_light(box_scene: SceneBuilder) -> None:
    scene = box_scene([((1.05, 0.0), 0.0, (0.1, 0.2, 0.2))])
    camera = Camera(type="rgb", position_m=(0.5, 0.0, 0.7), target_m=(1.05, 0.0, 0.7))
    light = np.array([[-3.0, 0.0, 4.0]]) / 5.0  # cosine 0.6 with the face's normal -x
    scene = scene.with_arrays({"light_direction": light, "light_intensity": np.array([0.5])})
    image = loaded(scene).render(FIRST, fixed_views(camera))
    # floor(255 * (0.86, 0.24, 0.2)) * (0.5 + 0.5 * 0.6), as whole levels
    np.testing.assert_array_equal(image[0, 40, 40], [175, 48, 40])
    np.testing.assert_array_equal(image[0, 0, 0], [255, 255, 255])


# -- the sensor ------------------------------------------------------------------------------------


def test_sense_without_noise_is_the_spaces_encoding() -> None:
    scenes, views = sampled(3)
    quiet = views["depth"].with_arrays({"noise_sigma_m": np.zeros(3)})
    simulator, seeds = loaded(scenes), np.arange(3).astype(np.uint64)
    depth = simulator.render(np.arange(3), quiet)
    for encoding, range_m in (("uint16", (0.4, 2.0)), ("uint8", (0.5, 1.1))):
        space = DepthImage(80, 80, range_m, encoding)
        raw = simulator.render_depth(np.arange(3), quiet, space, seeds)
        assert raw.dtype == space.dtype
        assert raw.shape == (3, 80, 80, 1)
        np.testing.assert_array_equal(raw, space.encode(depth))


def test_noise_has_the_sigma_of_its_view_and_depends_on_the_seed_alone() -> None:
    scenes, views = sampled(4)
    sigma = np.array([0.002, 0.004, 0.0, 0.002])
    noisy = views["depth"].with_arrays({"noise_sigma_m": sigma})
    simulator, space = loaded(scenes), DepthImage(80, 80, (0.1, 3.0))
    seeds = np.array([5, 6, 7, 5], np.uint64)
    depth = simulator.render(np.arange(4), noisy)
    raw = simulator.render_depth(np.arange(4), noisy, space, seeds)
    error = np.where(raw[..., 0] > 0, raw[..., 0] - 1000.0 * depth, np.nan)
    assert np.nanstd(error[0]) == pytest.approx(2.0, rel=0.05)
    assert np.nanstd(error[1]) == pytest.approx(4.0, rel=0.05)
    assert np.nanmax(np.abs(error[2])) <= 0.5001
    both = np.isfinite(error[0]) & np.isfinite(error[3])
    assert np.corrcoef(error[0][both], error[3][both])[0, 1] > 0.95  # but for the rounding
    both = np.isfinite(error[0]) & np.isfinite(error[1])
    assert abs(np.corrcoef(error[0][both], error[1][both])[0, 1]) < 0.06
    alone = simulator.render_depth(np.array([1, 3]), noisy[[1, 3]], space, seeds[[1, 3]])
    np.testing.assert_array_equal(alone, raw[[1, 3]])


def test_threefry_gives_the_published_numbers() -> None:
    """Known answers for 13 rounds, from the authors' Random123 (kat_vectors)."""
    digits_of_pi = (0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344)
    for counter, key, expected in (
        ((0, 0), (0, 0), (0x9D1C5EC6, 0x8BD50731)),
        ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, (0xFD36D048, 0x2D17272C)),
        (*digits_of_pi, (0xBA3E4725, 0xF27D669E)),
    ):
        words = [tuple(np.uint32(word) for word in pair) for pair in (key, counter)]
        assert threefry(*words) == expected


def test_normals_are_normal() -> None:
    count = 2_000_000
    sample = np.empty(count, np.float32)
    fill_normals(np.uint64(12345678901234567), sample)
    values = sample.astype(float)
    assert abs(values.mean()) < 4 / math.sqrt(count)
    assert abs(values.var() - 1.0) < 4 * math.sqrt(2 / count)
    assert abs((values**3).mean()) < 4 * math.sqrt(15 / count)
    assert abs((values**4).mean() - 3.0) < 4 * math.sqrt(96 / count)
    for bound in (0.1, 0.5, 1.0, 2.0, 3.0, 4.0):
        share = math.erfc(bound / math.sqrt(2.0))
        error = 4 * math.sqrt(share / count)
        assert (np.abs(values) > bound).mean() == pytest.approx(share, abs=error)
    # Kolmogorov and Smirnov's distance; 1.95 / sqrt(n) is exceeded once in a thousand times.
    ordered = np.sort(values[::20])
    expected = np.array([0.5 * math.erfc(-value / math.sqrt(2.0)) for value in ordered])
    rank = np.arange(1, len(ordered) + 1) / len(ordered)
    assert np.abs(rank - expected).max() < 1.95 / math.sqrt(len(ordered))


def test_normals_are_independent() -> None:
    pictures = np.empty((200, 6400), np.float32)
    for seed in range(200):
        fill_normals(np.uint64(seed), pictures[seed])
    limit = 5 / math.sqrt(pictures.size)
    for lag in (1, 2, 79, 80, 81, 3200):  # neighbours, rows, and the two numbers of a pair
        assert abs((pictures[:, lag:] * pictures[:, :-lag]).mean()) < limit
        squares = pictures**2 - 1.0
        assert abs((squares[:, lag:] * squares[:, :-lag]).mean()) < 3 * limit
    assert abs((pictures[1:] * pictures[:-1]).mean()) < limit  # of neighbouring seeds
    high = np.empty(6400, np.float32)
    fill_normals(np.uint64(1 << 40), high)
    assert not np.array_equal(high, pictures[0])  # all the bits of a seed count


# -- contacts --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tooltip", "yaw", "touched", "collided"),
    [
        ((1.0999, 0.0, 0.70), 0.0, False, False),  # a tenth of a millimetre before the face
        ((1.1001, 0.0, 0.70), 0.0, True, False),  # and in it
        ((1.099, 0.0, 0.70), 0.2, True, False),  # only the cup's rim, 6 mm before its middle
        ((1.0939, 0.0, 0.70), 0.2, False, False),  # 0.03 * sin(0.2) is 5.96 mm
        ((1.0941, 0.0, 0.70), 0.2, True, False),
        ((1.102, 0.1299, 0.70), 0.0, True, False),  # the cup's side at the face's
        ((1.102, 0.1301, 0.70), 0.0, False, False),
        ((1.1601, 0.0, 0.70), 0.0, True, True),  # the stem, too
        ((0.950, 0.0, 0.6299), 0.0, False, True),  # the cup in the table
        ((0.950, 0.0, 0.6301), 0.0, False, False),
        ((1.2501, -0.38, 0.70), 0.0, False, True),  # the cup in another block
        ((1.2499, -0.38, 0.70), 0.0, False, False),
    ],
)
def test_contacts_of_a_pose(
    box_scene: SceneBuilder,
    *,
    tooltip: tuple[float, float, float],
    yaw: float,
    touched: bool,
    collided: bool,
) -> None:
    target = ((1.10, 0.0), 0.0, (0.1, 0.2, 0.2))
    aside = ((1.25, -0.38), 0.0, (0.1, 0.15, 0.15))
    contacts = loaded(box_scene([target, aside])).move(FIRST, pose(*tooltip, yaw), RESOLUTION_M)
    assert (contacts.touched[0], contacts.collided[0]) == (touched, collided)


def test_contacts_are_those_of_all_poses_and_of_this_motion_only(box_scene: SceneBuilder) -> None:
    simulator = loaded(box_scene([((1.10, 0.0), 0.0, (0.1, 0.2, 0.2)), ASIDE]))
    free, touching = pose(1.0, 0.0, 0.8), pose(1.102, 0.0, 0.70)
    assert simulator.move(FIRST, straight_leg(touching[:, 0], free[:, 0]), RESOLUTION_M).touched[0]
    assert not simulator.move(FIRST, free, RESOLUTION_M).touched[0]


def turned(rng: np.random.Generator) -> np.ndarray:
    """A random rotation (3, 3)."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def gap(project: Callable[[np.ndarray], np.ndarray], box_half: np.ndarray) -> float:
    """Distance of a convex shape and a box, by projecting on the one and the other in turn."""
    point = np.zeros(3)
    for _ in range(2000):
        on_box = np.clip(point, -box_half, box_half)
        point = project(on_box)
    return float(np.linalg.norm(point - on_box))


@pytest.mark.parametrize("is_cylinder", [False, True])
def test_shapes_meet_where_their_distance_vanishes(is_cylinder: bool) -> None:
    rng, answers = np.random.default_rng(0), []
    for _ in range(60):
        turn, offset = turned(rng), rng.uniform(-0.3, 0.3, 3)
        half, box_half = rng.uniform(0.02, 0.2, (2, 3))
        half = half[[0, 0, 2]] if is_cylinder else half

        def project(
            point: np.ndarray, turn: np.ndarray = turn, offset: np.ndarray = offset, half=half
        ) -> np.ndarray:
            local = (point - offset) @ turn
            if is_cylinder:
                distance = np.hypot(local[0], local[1])
                local[:2] *= min(1.0, half[0] / max(distance, 1e-12))
                local[2] = np.clip(local[2], -half[2], half[2])
            else:
                local = np.clip(local, -half, half)
            return offset + turn @ local

        pair = make_pair()
        pair.offset[:], pair.turn[:] = offset, turn
        meet = (cylinder_meets_box if is_cylinder else boxes_meet)(half, box_half, pair)
        distance = gap(project, box_half)
        assert gap_between(is_cylinder, half, box_half, pair) <= distance + 1e-4
        assert meet == (distance < 1e-5) or 1e-5 < distance < 1e-4
        answers.append(meet)
    assert 10 < sum(answers) < 50


# -- many worlds -----------------------------------------------------------------------------------


def everything(simulator: FastSimulator, scenes: Scenes, views: dict[str, CameraPoses]) -> list:
    index, seeds = np.arange(len(scenes)), np.arange(len(scenes)).astype(np.uint64)
    contacts = simulator.move(index, reaching(scenes), RESOLUTION_M)
    return [
        contacts.touched,
        contacts.collided,
        *(simulator.render(index, view) for view in views.values()),
        simulator.render_depth(index, views["depth"], DepthImage(21, 33), seeds),
    ]


def test_results_do_not_depend_on_threads_nor_on_the_company() -> None:
    cameras = {
        kind: Camera(type=kind, width=33, height=21, fov_deg=60) for kind in ("depth", "rgb")
    }
    scenes, views = sampled(9, 0, **cameras)
    results = everything(loaded(scenes, threads=1), scenes, views)
    assert 0 < results[1].sum() < 9
    for threads in (2, 3):
        for one, many in zip(
            results, everything(loaded(scenes, threads), scenes, views), strict=True
        ):
            np.testing.assert_array_equal(one, many)
    again = everything(loaded(scenes), scenes, views)
    for i in (0, 5, 8):
        alone = loaded(scenes[i : i + 1])
        contacts = alone.move(FIRST, reaching(scenes)[i : i + 1], RESOLUTION_M)
        assert (contacts.touched[0], contacts.collided[0]) == (results[0][i], results[1][i])
        np.testing.assert_array_equal(alone.render(FIRST, views["rgb"][i : i + 1])[0], again[3][i])


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("rows", [0, 1, 8, 9, 100, 1023])
def test_a_team_does_every_row_once(threads: int, rows: int) -> None:
    team, done = ThreadPool(threads), np.zeros(rows, int)

    def work(begin: int, end: int) -> None:
        assert 0 <= begin <= end <= rows
        done[begin:end] += 1

    team.parallel_for(work, rows)
    team.close()
    team.close()
    np.testing.assert_array_equal(done, 1)


def test_a_teams_members_work_at_the_same_time_and_their_errors_are_passed_on() -> None:
    team, meeting = ThreadPool(2), threading.Barrier(2, timeout=10.0)
    team.parallel_for(lambda begin, end: print(meeting.wait()), 16)  # two parts: nobody works alone

    def fail(begin: int, end: int) -> None:
        meeting.wait()
        if begin:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        team.parallel_for(fail, 16)
    team.close()


def test_a_thousand_worlds() -> None:
    few, views = sampled(8, 0, depth=Camera(type="depth", width=16, height=16))
    many = few[np.tile(np.arange(8), 128)]
    simulator, index = loaded(many), np.arange(1024)
    contacts = simulator.move(index, np.tile(reaching(few), (128, 1, 1)), RESOLUTION_M)
    depth = simulator.render(index, views["depth"][np.tile(np.arange(8), 128)])
    np.testing.assert_array_equal(depth, np.tile(depth[:8], (128, 1, 1)))
    np.testing.assert_array_equal(contacts.touched, np.tile(contacts.touched[:8], 128))


def test_worlds_are_loaded_one_by_one_with_any_number_of_blocks(box_scene: SceneBuilder) -> None:
    one = box_scene([((1.1, 0.0), 0.0, (0.1, 0.2, 0.2))])
    two = box_scene([((1.1, 0.1), 0.2, (0.1, 0.2, 0.2)), ASIDE])
    simulator, views = FastSimulator(3, ROBOT, Support()), fixed_views(Camera(type="depth"))
    simulator.load(np.array([2]), one, home(1))
    simulator.load(np.array([0]), two, home(1))  # makes room for more boxes
    simulator.load(np.array([1]), two, home(1))
    simulator.load(np.array([1]), one, home(1))  # and leaves none of them behind
    seen = simulator.render(np.arange(3), views[np.zeros(3, int)])
    np.testing.assert_array_equal(seen[0], loaded(two).render(FIRST, views)[0])
    np.testing.assert_array_equal(seen[1], loaded(one).render(FIRST, views)[0])
    np.testing.assert_array_equal(seen[2], seen[1])
    np.testing.assert_array_equal(simulator.render(np.array([1]), views)[0], seen[1])


# -- mistakes --------------------------------------------------------------------------------------


def test_bad_input_is_refused_with_its_name() -> None:
    scenes, views = sampled(2)
    simulator, both, view = loaded(scenes), np.arange(2), views["depth"]
    seeds, path = np.zeros(2, np.uint64), reaching(scenes)

    def spoilt(batch, name: str, value: float):
        array = getattr(batch, name).copy()
        array.flat[-1] = value
        return replace(batch, **{name: array})

    for name in ("block_position_m", "block_yaw_rad", "light_direction", "light_intensity"):
        with pytest.raises(ValueError, match=f"{name}.*finite"):
            simulator.load(both, spoilt(scenes, name, np.nan), home(2))
    half = scenes.box_half_m.copy()
    half[0, 0, 0, 1] = 0.0
    with pytest.raises(ValueError, match=r"box_half_m.*over 0"):
        simulator.load(both, scenes.with_arrays({"box_half_m": half}), home(2))
    with pytest.raises(ValueError, match="2 worlds need 2 scenes"):
        simulator.load(both, scenes[:1], home(2))
    with pytest.raises(ValueError, match=r"joints_rad.*finite"):
        simulator.load(both, scenes, home(2) * np.nan)
    with pytest.raises(ValueError, match=r"path_rad.*finite"):
        simulator.move(both, path * [1, 1, 1, 1, 1, np.inf], RESOLUTION_M)
    with pytest.raises(ValueError, match=r"2 k \+ 1 knots"):
        simulator.move(both, path[:, :0], RESOLUTION_M)
    with pytest.raises(ValueError, match=r"path_rad.*shape"):
        simulator.move(both, path[:, :, :5], RESOLUTION_M)
    with pytest.raises(ValueError, match=r"position_m of the views.*finite"):
        simulator.render(both, spoilt(view, "position_m", np.nan))
    with pytest.raises(ValueError, match=r"rotation of the views.*orthonormal"):
        simulator.render(both, spoilt(view, "rotation", 2.0))
    with pytest.raises(ValueError, match="near_m of the views"):
        simulator.render(both, spoilt(view, "near_m", 9.0))
    with pytest.raises(ValueError, match=r"noise_sigma_m must be within 0 and 1"):
        simulator.render_depth(
            both, spoilt(view, "noise_sigma_m", np.nan), DepthImage(80, 80), seeds
        )
    with pytest.raises(ValueError, match=r"DepthImage.*80x80"):
        simulator.render_depth(both, view, DepthImage(80, 81), seeds)
    with pytest.raises(ValueError, match="as many seeds"):
        simulator.render_depth(both, view, DepthImage(80, 80), seeds[:1])
    for wrong in ([0, 2], [1, 0], [0, 0], [-1, 0]):
        with pytest.raises(ValueError, match="indices must rise"):
            simulator.move(np.array(wrong), path, RESOLUTION_M)
    fresh = FastSimulator(2, ROBOT, Support())
    fresh.load(FIRST, scenes[:1], home(1))
    with pytest.raises(ValueError, match=r"worlds \[1\] hold no scene"):
        fresh.move(both, path, RESOLUTION_M)
    with pytest.raises(ValueError, match="0 threads"):
        FastSimulator(2, ROBOT, Support(), threads=0)


# -- in the environment ----------------------------------------------------------------------------


def test_the_factory_builds_it() -> None:
    settings = GraspSettings(simulator="fast", num_envs=3)
    assert isinstance(make_simulator(settings, ROBOT, 3), FastSimulator)
    assert isinstance(make_simulator(GraspSettings(workers=0), ROBOT, 1), PyBulletSimulator)
    with pytest.raises(ValueError, match="rgb_array"):
        make_simulator(settings, ROBOT, 3, window=True)


def test_an_environment_pays_what_pybullets_does() -> None:
    rewards = {"touch": 1.0, "collision": 1.0, "position": 1.0, "approach": 1.0}
    camera, rng = Camera(type="depth", noise_sigma_m=0.0), np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (12, 8, 4))
    results = []
    for simulator in ("pybullet", "fast"):
        env = make_vector_env(
            8,
            seed=3,
            rewards=rewards,
            simulator=simulator,
            workers=0,
            cameras={"depth": camera},
            frame_grab=False,
        )
        env.reset()
        steps = [env.step(action) for action in actions]
        env.close()
        results.append(
            [np.stack([step[k] for step in steps]) for k in (1, 2, 3)]
            + [np.stack([step[0]["depth"] for step in steps])]
        )
    (*exact, exact_depth), (*fast, fast_depth) = results
    for one, other in zip(exact, fast, strict=True):
        np.testing.assert_allclose(one, other)
    assert exact[2].any()  # episodes ended on the way
    error_mm = np.abs(exact_depth.astype(int) - fast_depth)
    assert (error_mm <= 1).mean() > 0.99


def test_a_second_start_compiles_nothing() -> None:
    """What this process has compiled or found is what the next one finds."""
    loaded(sampled(1)[0]).move(FIRST, pose(1.0, 0.0, 0.8), RESOLUTION_M)
    code = (
        "import numpy as np\n"
        "from envs.grasp.robot.urdf import load_robot\n"
        "from envs.grasp.scene.sampler import SceneSampler\n"
        "from envs.grasp.settings import GraspSettings, Support\n"
        "from envs.grasp.simulators.fast import FastSimulator\n"
        "from envs.grasp.simulators.kernels.contacts import touch_along\n"
        "scenes, _ = SceneSampler(GraspSettings()).sample(np.random.default_rng(0), np.ones(1))\n"
        "robot = load_robot()\n"
        "simulator, home = FastSimulator(1, robot, Support()), robot.home_rad[None]\n"
        "simulator.load(np.array([0]), scenes, home)\n"
        "simulator.move(np.array([0]), home[:, None], 0.005)\n"
        "print(sum(touch_along.stats.cache_misses.values()))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=ROOT, capture_output=True, text=True
    )
    assert run.stdout.split()[-1] == "0"
