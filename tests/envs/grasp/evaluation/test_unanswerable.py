"""Images in which there is nothing to grasp: that there isn't, and that nobody notices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from encoders.spaces import DepthImage
from envs.cameras import look_at
from envs.evaluation import Unanswerable
from envs.grasp.evaluation.unanswerable import unanswerable
from envs.grasp.robot.urdf import load_robot
from envs.grasp.sensors.clouds import CloudCamera
from envs.grasp.settings import Camera, Cloud, GraspSettings, Randomize, Surroundings
from envs.grasp.vector_env import GraspVectorEnv
from trainers.inference.policy import Policy

POLICIES = sorted((Path(__file__).parents[4] / "policies").iterdir())
COUNT = 12
CAMERA = Camera(
    type="depth",
    width=48,
    height=40,
    fov_deg=55.0,
    position_m=(0.30, 0.0, 1.20),
    target_m=(1.10, 0.0, 0.68),
    noise_sigma_m=0.0,
)
FIXED = {"camera_position_m": 0.0, "camera_rotation_deg": 0.0}
REFUSED = {"no block", "out of reach", "a plane", "planes", "nothing seen", "noise"}


def settings_of(camera: Camera = CAMERA, **randomize: Any) -> GraspSettings:
    return GraspSettings(
        simulator="fast", cameras={"eye": camera}, randomize=Randomize(**{**FIXED, **randomize})
    )


def kinds(settings: GraspSettings, seed: int = 0) -> dict[str, Unanswerable]:
    return {one.kind: one for one in unanswerable(settings, load_robot(), COUNT, seed)}


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return {kind: one.observations["eye"] for kind, one in kinds(settings_of()).items()}


def points(images: np.ndarray) -> np.ndarray:
    """What is seen, (k, 3), in the world."""
    settings = settings_of()
    env = GraspVectorEnv(settings.model_copy(update={"num_envs": 1}), ())
    space = env.single_observation_space["eye"]
    env.close()
    assert isinstance(space, DepthImage)
    assert space.pinhole is not None
    depth_m = images[..., 0] / 1000.0
    local = depth_m[..., None] * space.pinhole.rays(*space.shape[:2])
    position_m = np.array(CAMERA.position_m)
    rotation = look_at(position_m, np.array(CAMERA.target_m), 0.0)
    found: np.ndarray = (local @ rotation.T + position_m)[images[..., 0] > 0]
    return found


def test_there_are_kinds_that_are_foreseen_and_others(images: dict[str, np.ndarray]) -> None:
    found = kinds(settings_of())
    assert {kind for kind, one in found.items() if one.use == "refuse"} == REFUSED
    assert [kind for kind, one in found.items() if one.use == "learn"] == ["another unit"]
    assert len(found) > len(REFUSED)
    for image in images.values():
        assert image.shape == (COUNT, 40, 48, 1)
        assert image.dtype == np.uint16


def test_blocks_are_away_or_out_of_reach(images: dict[str, np.ndarray]) -> None:
    settings = settings_of()
    raised = settings.support.top_m + 0.02
    # Nearer than that is the robot's own arm.
    x, _, z = points(images["no block"]).T
    assert not (z[x > 0.85] > raised).any()
    x, _, z = points(images["out of reach"]).T
    beyond = x[(x > 0.85) & (z > raised)]
    assert len(beyond) > 50 * COUNT / 12
    assert beyond.min() > settings.workspace.x_m[1]


def test_a_plane_is_flat_and_balls_are_not(images: dict[str, np.ndarray]) -> None:
    rows, columns = np.indices((40, 48))

    def off_a_plane_m(image: np.ndarray) -> float:
        """Median distance in depth from 1 / z = a + b column + c row, fitted to what is seen."""
        seen = image > 0
        design = np.stack([np.ones(seen.sum()), columns[seen], rows[seen]], axis=1)
        depth_m = image[seen] / 1000.0
        found, *_ = np.linalg.lstsq(design, 1.0 / depth_m, rcond=None)
        return float(np.abs(1.0 / (design @ found) - depth_m).max())

    for kind, is_flat in (("a plane", True), ("balls", False), ("a corner", False)):
        seen = [image[..., 0] for image in images[kind] if (image > 0).sum() > 300]
        off_m = [off_a_plane_m(image) for image in seen]
        assert len(seen) > COUNT / 2
        assert (np.median(off_m) < 0.002) == is_flat


def test_the_rest_is_what_it_is_called(images: dict[str, np.ndarray]) -> None:
    assert not images["nothing seen"].any()
    assert all(len(np.unique(image[image > 0])) <= 1 for image in images["one depth"])
    assert (np.abs(np.diff(images["noise"].astype(int), axis=2)) > 0).mean() > 0.5
    upright, scaled = images["upside down"][:, ::-1, ::-1], images["another unit"]
    ratio = np.where(upright > 0, scaled / np.maximum(upright, 1), np.nan)
    is_far = np.nanmedian(ratio, axis=(1, 2, 3)) > 1.0
    assert is_far.any()
    assert np.nanmin(ratio[is_far]) > 1.149
    assert np.nanmax(ratio[is_far]) < 1.601
    nearer = np.nanmedian(1.0 / ratio[~is_far], axis=(1, 2, 3))  # whole codes, of which 0 is none
    assert len(nearer)
    assert nearer.min() > 1.149
    assert nearer.max() < 1.603
    x, _, z = points(upright).T
    assert (z[(x > 0.85) & (x < 1.35)] > 0.7).any()


def test_seeds_decide_and_episodes_do_not_notice() -> None:
    settings = settings_of().model_copy(update={"num_envs": 3})
    env = GraspVectorEnv(settings, ())
    try:
        env.reset(seed=5)
        before = env.state_dict()
        shown = [
            {one.kind: one.observations["eye"] for one in env.evaluator().unanswerable(4, seed)}
            for seed in (1, 1, 2)
        ]
        after = env.state_dict()
    finally:
        env.close()
    assert before["rng"] == after["rng"]
    np.testing.assert_array_equal(before["images"]["eye"], after["images"]["eye"])
    for kind, image in shown[0].items():
        np.testing.assert_array_equal(image, shown[1][kind])
        if kind not in ("nothing seen", "no block"):  # without noise, nothing in them is drawn
            assert (image != shown[2][kind]).any()


def test_colours_and_surroundings_are_shown() -> None:
    color = Camera(type="rgb", width=20, height=16)
    found = kinds(settings_of(color))
    for one in found.values():
        assert one.observations["eye"].shape == (COUNT, 16, 20, 3)
        assert one.observations["eye"].dtype == np.uint8
    wall = Surroundings(wall=1.0, rack=0.0, things=(2, 2))
    around = kinds(settings_of(surroundings=wall))["no block"].observations["eye"]
    assert (around > 0).mean() > (kinds(settings_of())["no block"].observations["eye"] > 0).mean()


def test_clouds_are_made_of_the_same_images(images: dict[str, np.ndarray]) -> None:
    cloud = Cloud(points=40 * 48, frame="camera")
    camera = CAMERA.model_copy(update={"type": "points", "cloud": cloud})
    maker = CloudCamera(camera)
    found = kinds(settings_of(camera))
    assert found.keys() == images.keys()
    # What is drawn for clouds comes in between, so that only the first ones are the very same.
    first = [maker.image(row) for row in found["no block"].observations["eye"]]
    np.testing.assert_array_equal(np.stack(first), images["no block"])
    for one in found.values():
        assert maker.space.contains(one.observations["eye"][0]), one.kind
    assert not found["nothing seen"].observations["eye"].any()


@pytest.mark.parametrize("folder", POLICIES, ids=lambda folder: folder.name)
def test_the_shipped_policies_are_never_sure_of_them(folder: Path) -> None:
    policy = Policy.load(folder)
    settings = settings_of_policy(folder)
    for one in unanswerable(settings, load_robot(), 64, seed=123):
        assert not policy.answer(one.observations).sure.any(), one.kind


def settings_of_policy(folder: Path) -> GraspSettings:
    from trainers.evaluation import find_run

    _, run = find_run(str(folder), (), Path("results"))
    assert isinstance(run.environment.settings, GraspSettings)
    return run.environment.settings
