from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pybullet
import pytest
from worlds import FIRST, RESOLUTION_M, ROBOT, fixed_views, home, pose, reaching, sampled

from encoders.spaces import DepthImage
from envs.grasp.robot.paths import straight_leg
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses, pinhole, sample_views
from envs.grasp.sensors.depth import sense_depth
from envs.grasp.settings import Camera, GraspSettings, Support
from envs.grasp.simulators import pybullet as pybullet_module
from envs.grasp.simulators.factory import make_simulator
from envs.grasp.simulators.pybullet import PyBulletSimulator
from envs.grasp.simulators.workers import ParallelSimulator

ROOT = Path(__file__).parents[4]
SceneBuilder = Callable[..., Scenes]
# Far from everything the tests do with the target.
ASIDE = ((1.35, -0.38), 0.0, (0.1, 0.15, 0.15))


@pytest.fixture
def simulate() -> Iterator[Callable[[Scenes], PyBulletSimulator]]:
    """Builds simulators that hold given scenes, the robots in their home pose."""
    simulators = []

    def build(scenes: Scenes) -> PyBulletSimulator:
        simulator = PyBulletSimulator(len(scenes), ROBOT, Support())
        simulators.append(simulator)
        simulator.load(np.arange(len(scenes)), scenes, home(len(scenes)))
        return simulator

    yield build
    for simulator in simulators:
        simulator.close()


# -- depth -----------------------------------------------------------------------------------------


def cast_rays(scenes: Scenes, views: CameraPoses) -> tuple[np.ndarray, np.ndarray]:
    """Depth along the optical axis (n, H, W) through the pixels' centres, and what is hit there.

    Written from the geometry alone: each ray is turned into each box's frame and clipped there.
    """
    camera, support = views.camera, Support()
    focal, rows = pinhole(camera).fx, len(scenes)
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack(
        [
            (column - camera.width / 2) / focal,
            (row - camera.height / 2) / focal,
            np.ones_like(column),
        ],
        axis=-1,
    )
    depth = np.full((rows, camera.height, camera.width), np.inf)
    hit = np.zeros(depth.shape, int)
    table = np.array(
        [support.x_m, support.y_m, (support.top_m - support.thickness_m, support.top_m)]
    )
    for i in range(rows):
        boxes = [(np.zeros(3), 0.0, table.mean(1), np.ptp(table, axis=1) / 2)]
        boxes += [
            (
                scenes.block_position_m[i, b],
                scenes.block_yaw_rad[i, b],
                scenes.box_center_m[i, b, k],
                scenes.box_half_m[i, b, k],
            )
            for b in range(scenes.box_half_m.shape[1])
            for k in range(3)
            if scenes.box_half_m[i, b, k].all()
        ]
        world = rays @ views.rotation[i].T
        for number, (position, yaw, center, half) in enumerate(boxes, start=1):
            back = np.array(
                [[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
            )
            origin = back @ (views.position_m[i] - position) - center
            with np.errstate(divide="ignore"):
                ends = np.stack([(side * half - origin) / (world @ back.T) for side in (-1, 1)])
            enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
            nearer = (enter <= leave) & (enter > 0) & (enter < depth[i])
            depth[i] = np.where(nearer, enter, depth[i])
            hit[i] = np.where(nearer, number, hit[i])
    return depth, hit


def off_silhouettes(hit: np.ndarray) -> np.ndarray:
    """Pixels all of whose eight neighbours hit the same thing."""
    padded = np.pad(hit, ((0, 0), (1, 1), (1, 1)), mode="edge")
    height, width = hit.shape[1:]
    return np.logical_and.reduce(
        [padded[:, r : r + height, c : c + width] == hit for r in range(3) for c in range(3)]
    )


@pytest.mark.parametrize(
    ("width", "height", "fov_deg"), [(80, 80, 44.0), (120, 50, 60.0), (41, 67, 50.0)]
)
def test_depth_is_that_of_rays_through_the_pixels_centres(
    simulate: Callable[[Scenes], PyBulletSimulator], width: int, height: int, fov_deg: float
) -> None:
    camera = Camera(type="depth", width=width, height=height, fov_deg=fov_deg)
    # faces need not all be in view of the flat image
    scenes, views = sampled(8)
    views = fixed_views(camera, 8).with_arrays(
        {"position_m": views["depth"].position_m, "rotation": views["depth"].rotation}
    )
    depth = simulate(scenes).render(np.arange(8), views)
    expected, hit = cast_rays(scenes, views)
    assert depth.shape == (8, height, width)
    assert depth.dtype == np.float32
    inner = off_silhouettes(hit)
    assert inner.mean() > 0.6
    np.testing.assert_array_equal(np.isfinite(depth)[inner], np.isfinite(expected)[inner])
    compared = inner & np.isfinite(expected)
    assert len(np.unique(hit[compared])) > 5
    error_mm = 1000 * np.abs(depth[compared] - expected[compared])
    assert np.median(error_mm) < 0.01
    assert np.percentile(error_mm, 99) < 0.1


def test_depth_is_not_only_right_for_the_camera_in_its_middle_position(
    simulate: Callable[[Scenes], PyBulletSimulator],
) -> None:
    # From the side, rolled, with clip planes of its own.
    camera = Camera(
        type="depth", position_m=(1.0, 1.2, 1.3), target_m=(1.15, 0.0, 0.65), near_m=(0.3, 0.3)
    )
    scenes, _ = sampled(3)
    rng = np.random.default_rng(0)
    views = sample_views(camera, rng, 3, 0.1, 20.0)
    depth = simulate(scenes).render(np.arange(3), views)
    expected, hit = cast_rays(scenes, views)
    compared = off_silhouettes(hit) & np.isfinite(expected) & (expected < 1.4)
    compared &= depth > expected - 0.02  # the robot is in this picture, and in front
    assert compared.mean() > 0.1
    assert np.percentile(1000 * np.abs(depth[compared] - expected[compared]), 99) < 0.1


def test_nothing_is_seen_beyond_the_far_plane(
    simulate: Callable[[Scenes], PyBulletSimulator],
) -> None:
    scenes, _ = sampled(4)
    camera = Camera(type="depth", far_m=(0.95, 0.95))
    views = fixed_views(camera, 4)
    depth = simulate(scenes).render(np.arange(4), views)
    expected, hit = cast_rays(scenes, views)
    inner = off_silhouettes(hit)
    beyond, before = inner & (expected > 0.955), inner & (expected < 0.945)
    assert beyond.mean() > 0.1
    assert before.mean() > 0.1
    assert np.isinf(depth[beyond]).all()
    np.testing.assert_allclose(depth[before], expected[before], atol=2e-4)


def test_sense_is_the_rendered_depth_with_the_sensors_model(
    simulate: Callable[[Scenes], PyBulletSimulator],
) -> None:
    scenes, views = sampled(2)
    simulator, space = simulate(scenes), DepthImage(80, 80)
    seeds = np.array([7, 8], np.uint64)
    raw = simulator.render_depth(np.arange(2), views["depth"], space, seeds)
    depth = simulator.render(np.arange(2), views["depth"])
    np.testing.assert_array_equal(raw, sense_depth(depth, views["depth"], space, seeds))
    error = raw[..., 0] - 1000 * depth
    seen = np.isfinite(depth) & (depth > 0.5) & (depth < 1.9)
    assert error[seen].std() == pytest.approx(2.0, rel=0.1)


# -- color -----------------------------------------------------------------------------------------

RGB = Camera(type="rgb", width=120, height=80)


def lit(scene: Scenes, direction: tuple[float, float, float], intensity: float) -> Scenes:
    unit = np.array([direction]) / np.linalg.norm(direction)
    return scene.with_arrays({"light_direction": unit, "light_intensity": np.array([intensity])})


def test_color_depends_on_the_light(
    simulate: Callable[[Scenes], PyBulletSimulator], box_scene: SceneBuilder
) -> None:
    scene = box_scene([((1.05, 0.0), 0.0, (0.1, 0.2, 0.2))])
    views = fixed_views(RGB)
    u, v, _ = _middle_of_face(views)
    images = []
    for direction, intensity in (((-1, 0, 0.5), 0.9), ((1, 0, 0.5), 0.9), ((1, 0, 0.5), 0.4)):
        image = simulate(lit(scene, direction, intensity)).render(FIRST, views)
        assert image.shape == (1, 80, 120, 3)
        assert image.dtype == np.uint8
        images.append(image[0].astype(int))
    front, behind, ambient = images
    face_front, face_behind, face_ambient = (image[v, u].sum() for image in images)
    assert face_front > 2 * face_behind  # lit from the robot's side, or from behind
    assert face_ambient > 1.5 * face_behind  # in the shade, only the ambient share counts
    assert np.abs(front - behind).max() > 50
    assert np.abs(behind - ambient).max() > 20
    red, green, blue = front[v, u]
    assert red > 1.5 * max(green, blue)  # red, green, blue in this order


def _middle_of_face(views: CameraPoses) -> tuple[int, int, float]:
    camera = views.camera
    away = np.array([1.05, 0.0, 0.7]) - views.position_m[0]
    x, y, z = away @ views.rotation[0]
    focal = pinhole(camera).fx
    return int(camera.width / 2 + focal * x / z), int(camera.height / 2 + focal * y / z), z


def test_color_and_depth_show_the_same_scene(
    simulate: Callable[[Scenes], PyBulletSimulator], box_scene: SceneBuilder
) -> None:
    scene = lit(box_scene([((1.05, 0.0), 0.3, (0.1, 0.2, 0.2))]), (-1, 0, 0.5), 0.9)
    simulator = simulate(scene)
    depth_camera = Camera(type="depth", width=120, height=80)
    _, hit = cast_rays(scene, fixed_views(depth_camera))
    image = simulator.render(FIRST, fixed_views(RGB))[0].astype(int)
    red = image[..., 0] > 1.5 * image[..., 1:].max(-1)
    inner = off_silhouettes(hit)[0]
    np.testing.assert_array_equal(red[inner], (hit[0] == 2)[inner])


# -- contacts --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tooltip", "yaw", "touched", "collided"),
    [
        ((1.085, 0.0, 0.70), 0.0, False, False),  # in front of the face
        ((1.099, 0.0, 0.70), 0.0, False, False),
        ((1.102, 0.0, 0.70), 0.0, True, False),  # the cup presses on it
        ((1.099, 0.0, 0.70), 0.2, True, False),  # its rim does
        ((1.102, 0.12, 0.70), 0.0, True, False),  # half of the cup beside the face
        ((1.102, 0.135, 0.70), 0.0, False, False),  # all of it
        ((1.150, 0.0, 0.70), 0.0, True, True),  # the stem has entered too
        ((0.950, 0.0, 0.625), 0.0, False, True),  # the cup in the table
        ((0.950, 0.0, 0.640), 0.0, False, False),  # and over it
        ((1.255, -0.38, 0.70), 0.0, False, True),  # the cup in another block
        ((1.240, -0.38, 0.70), 0.0, False, False),
    ],
)
def test_contacts_of_a_pose(
    simulate: Callable[[Scenes], PyBulletSimulator],
    box_scene: SceneBuilder,
    *,
    tooltip: tuple[float, float, float],
    yaw: float,
    touched: bool,
    collided: bool,
) -> None:
    target = ((1.10, 0.0), 0.0, (0.1, 0.2, 0.2))
    aside = ((1.25, -0.38), 0.0, (0.1, 0.15, 0.15))
    contacts = simulate(box_scene([target, aside])).move(FIRST, pose(*tooltip, yaw), RESOLUTION_M)
    assert (contacts.touched[0], contacts.collided[0]) == (touched, collided)


def test_touching_and_colliding_at_once(
    simulate: Callable[[Scenes], PyBulletSimulator], box_scene: SceneBuilder
) -> None:
    scene = box_scene([((1.10, 0.0), 0.0, (0.1, 0.2, 0.2)), ASIDE])
    contacts = simulate(scene).move(FIRST, pose(1.102, 0.0, 0.625), RESOLUTION_M)
    assert contacts.touched[0]
    assert contacts.collided[0]


def test_a_link_of_the_arm_collides_with_the_target_too(
    simulate: Callable[[Scenes], PyBulletSimulator], box_scene: SceneBuilder
) -> None:
    # The cup is past a low target, over which the wrist lies.
    scene = box_scene([((0.90, 0.0), 0.0, (0.08, 0.12, 0.12)), ASIDE])
    contacts = simulate(scene).move(FIRST, pose(1.10, 0.0, 0.72), RESOLUTION_M)
    assert not contacts.touched[0]
    assert contacts.collided[0]


def test_contacts_of_a_path_are_those_of_all_its_poses(
    simulate: Callable[[Scenes], PyBulletSimulator], box_scene: SceneBuilder
) -> None:
    scene = box_scene([((1.10, 0.0), 0.0, (0.1, 0.2, 0.2)), ASIDE])
    free, touching = pose(1.0, 0.0, 0.8), pose(1.102, 0.0, 0.70)
    simulator = simulate(scene)
    assert simulator.move(FIRST, straight_leg(touching[:, 0], free[:, 0]), RESOLUTION_M).touched[0]
    # Nothing is kept from one motion to the next.
    assert not simulator.move(FIRST, free, RESOLUTION_M).touched[0]


def test_what_lies_between_two_poses_is_not_missed(
    simulate: Callable[[Scenes], PyBulletSimulator], box_scene: SceneBuilder
) -> None:
    wall = ((1.00, 0.0), 0.0, (0.004, 0.12, 0.24))
    simulator = simulate(box_scene([((1.30, 0.30), 0.0, (0.1, 0.12, 0.12)), wall]))
    right, left = pose(1.1, -0.35, 0.7)[:, 0], pose(1.1, 0.35, 0.7)[:, 0]
    for end in (right, left):
        assert not simulator.move(FIRST, end[:, None], RESOLUTION_M).collided[0]
    assert simulator.move(FIRST, straight_leg(right, left), RESOLUTION_M).collided[0]
    over = straight_leg(pose(1.1, -0.35, 1.0)[:, 0], pose(1.1, 0.35, 1.0)[:, 0])
    assert not simulator.move(FIRST, over, RESOLUTION_M).collided[0]


def test_the_robot_stays_where_it_moved(
    simulate: Callable[[Scenes], PyBulletSimulator], box_scene: SceneBuilder
) -> None:
    simulator = simulate(box_scene([((1.3, 0.3), 0.0, (0.1, 0.15, 0.15))]))
    views = fixed_views(Camera(type="depth"))
    before = simulator.render(FIRST, views)
    simulator.move(FIRST, pose(1.1, 0.0, 0.8), RESOLUTION_M)
    after = simulator.render(FIRST, views)
    assert (after < before - 0.05).mean() > 0.01  # it is in the picture now
    simulator.move(FIRST, home(1)[:, None], RESOLUTION_M)
    np.testing.assert_array_equal(simulator.render(FIRST, views), before)


# -- many worlds -----------------------------------------------------------------------------------


def test_worlds_of_one_client_do_not_see_each_other(
    simulate: Callable[[Scenes], PyBulletSimulator],
) -> None:
    count = 18  # worlds share clients, and there are several clients
    scenes, views = sampled(count)
    shared = simulate(scenes)
    path = reaching(scenes, 0)
    contacts = shared.move(np.arange(count), path, RESOLUTION_M)
    images = shared.render(np.arange(count), views["depth"])
    again = shared.render(np.arange(count)[::3], views["depth"][::3])
    np.testing.assert_array_equal(again, images[::3])
    for i in range(count):
        alone = simulate(scenes[i : i + 1])
        single = alone.move(FIRST, path[i : i + 1], RESOLUTION_M)
        assert single.touched[0] == contacts.touched[i]
        assert single.collided[0] == contacts.collided[i]
        np.testing.assert_array_equal(alone.render(FIRST, views["depth"][i : i + 1])[0], images[i])
    assert 0 < contacts.touched.sum() < count
    assert 0 < contacts.collided.sum() < count


def rollout(simulator: PyBulletSimulator, count: int) -> list[np.ndarray]:
    """Loads, moves and pictures in an order that leaves some worlds waiting for long."""
    rng, seen, everywhere = np.random.default_rng(0), [], np.arange(count)
    first, _ = sampled(count, 100)
    simulator.load(everywhere, first, home(count))
    simulator.move(everywhere, reaching(first, 5), RESOLUTION_M)
    views = fixed_views(Camera(type="depth", width=40, height=40), count)
    for step in range(8):
        index = np.flatnonzero(rng.random(count) < 0.6)
        index = index[index % 2 == 1] if step < 6 else index  # every second world waits
        scenes, _ = sampled(len(index), step)
        simulator.load(index, scenes, home(len(index)))
        contacts = simulator.move(index, reaching(scenes, step), RESOLUTION_M)
        seen += [contacts.touched, contacts.collided, simulator.render(everywhere, views)]
    return seen


def test_resetting_the_simulation_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for loads in (10_000, 1, 4):
        monkeypatch.setattr(pybullet_module, "LOADS_BEFORE_RESET", loads)
        resets = []
        reset = pybullet.resetSimulation
        with monkeypatch.context() as patch:
            patch.setattr(
                pybullet,
                "resetSimulation",
                lambda r=reset, log=resets, **k: (log.append(1), r(**k)),
            )
            simulator = PyBulletSimulator(10, ROBOT, Support())
            results.append(rollout(simulator, 10))
            simulator.close()
        assert bool(resets) == (loads < 10_000)
    for other in results[1:]:
        for expected, seen in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(seen, expected)


def resident_mb() -> float:
    status = Path("/proc/self/status").read_text(encoding="utf8")
    return int(re.search(r"VmRSS:\s+(\d+)", status).group(1)) / 1024


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_memory_does_not_grow_with_loads(
    simulate: Callable[[Scenes], PyBulletSimulator],
) -> None:
    scenes, _ = sampled(1)
    simulator, loads = simulate(scenes), pybullet_module.LOADS_BEFORE_RESET
    (client,) = simulator._clients
    for _ in range(loads):
        simulator.load(FIRST, scenes, home(1))
    bodies, start = pybullet.getNumBodies(client._id), resident_mb()
    for _ in range(4 * loads):
        simulator.load(FIRST, scenes, home(1))
    assert pybullet.getNumBodies(client._id) == bodies == 2 + 3
    assert resident_mb() - start < 20  # more than twice that without the resets


# -- which simulator -------------------------------------------------------------------------------


def test_factory_obeys_the_number_of_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        "envs.grasp.simulators.workers.ParallelSimulator",
        lambda worlds, workers, _robot, _support: asked.append((worlds, workers)),
    )
    monkeypatch.setattr("envs.grasp.simulators.factory.usable_cores", lambda: 4)
    for workers, worlds in ((None, 64), (None, 8), (3, 64), (5, 2)):
        make_simulator(GraspSettings(workers=workers), ROBOT, worlds)
    # One a core, but none with fewer than four worlds; never more workers than worlds.
    assert asked == [(64, 4), (8, 2), (64, 3), (2, 2)]
    for workers, worlds in ((0, 64), (None, 4), (None, 1)):
        simulator = make_simulator(GraspSettings(workers=workers), ROBOT, worlds)
        assert isinstance(simulator, PyBulletSimulator)
        assert not isinstance(simulator, ParallelSimulator)
        simulator.close()
    assert len(asked) == 4


def test_closing_twice_does_no_harm() -> None:
    simulator = PyBulletSimulator(18, ROBOT, Support())
    clients = [client._id for client in simulator._clients]
    assert len(clients) > 1
    assert all(pybullet.isConnected(client) for client in clients)
    simulator.close()
    simulator.close()
    assert not any(pybullet.isConnected(client) for client in clients)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X11")
@pytest.mark.parametrize("display", [None, ":987"])
def test_a_window_without_a_display_is_an_error_and_not_the_end(display: str | None) -> None:
    code = (
        "import gymnasium, envs\n"
        "try:\n"
        "    gymnasium.make('ventosa/Grasp-v0', render_mode='human')\n"
        "except ValueError as error:\n"
        "    print('caught', error)\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    environment |= {"DISPLAY": display} if display else {}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"caught .*(DISPLAY|libX11).*", done.stdout), done.stdout
    if display and "libX11" not in done.stdout:
        assert f"DISPLAY={display}" in done.stdout
        assert "rgb_array" in done.stdout


def test_a_window_shows_motions_at_the_same_pace_whatever_is_near(
    simulate: Callable[..., PyBulletSimulator],
    box_scene: SceneBuilder,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sleeps: list[float] = []
    monkeypatch.setattr(time, "sleep", sleeps.append)
    path = straight_leg(pose(1.1, -0.3, 0.8)[:, 0], pose(1.1, 0.3, 0.8)[:, 0])
    counts = []
    for x in (1.1, 1.4):
        simulator = simulate(box_scene([((x, 0.0), 0.0, (0.1, 0.1, 0.15))]))
        (client,) = simulator._clients
        simulator.move(FIRST, path, RESOLUTION_M)
        assert not sleeps
        client._window = True
        simulator.move(FIRST, path, RESOLUTION_M)
        counts.append(len(sleeps))
        joints = [
            pybullet.getJointState(client._robot.body, joint, client._id)[0]
            for joint in client._robot.joints
        ]
        np.testing.assert_allclose(joints, path[0, -1])
        sleeps.clear()
    assert counts[0] == counts[1] > 10
