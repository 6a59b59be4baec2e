"""Policies from raw values on, with a camera that is not the one of training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict

from encoders.cameras import Distortion, Pinhole, Sampling
from encoders.conv import Conv
from encoders.keypoints import Keypoints
from encoders.spaces import DepthImage, RgbImage
from envs.deployment import Deployment, Meaning, Mount, Quantity
from envs.views import CameraFile
from trainers.common.errors import UserError
from trainers.inference.fitting import fit
from trainers.inference.policy import Policy
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.factory import NetworkFactory
from trainers.runfile.settings import Component

SENSOR = Sampling(40, 36, 2, 4, 12, 10, 3)
PINHOLE = Pinhole(12.0, 13.0, 6.5, 4.5)
REAL = Pinhole(39.0, 37.0, 20.5, 18.0)
IMAGE = DepthImage(10, 12, (0.4, 2.0), pinhole=PINHOLE, sampling=SENSOR)
KEYPOINTS = Component("keypoints", Keypoints, Keypoints.Settings(keypoints=2, patch=4, stride=2))
CONV = Component("conv", Conv, Conv.Settings(layers=[(4, 4, 2)]))
ACTIONS = Box(np.array([-1.0, -1.0, -1.0, -2.0], np.float32), np.float32(1.0))
RANGES = {"x_m": (0.8, 1.2), "y_m": (-0.4, 0.4), "z_m": (0.6, 1.0), "heading": (-0.5, 0.7)}
PLACE = Meaning(
    name="place",
    quantities=tuple(
        Quantity(name=name, low=low, high=high, label=name) for name, (low, high) in RANGES.items()
    ),
    is_place=True,
)
MOUNT = Mount.of(np.array([0.1, 0.2, 1.0]), np.eye(3))

Make = Callable[..., Policy]


@pytest.fixture
def make(make_factory: Callable[..., NetworkFactory]) -> Make:
    """Policies with the same weights for different images."""

    def build(space: Any = IMAGE, encoder: Component = KEYPOINTS, actions: Any = ACTIONS) -> Policy:
        torch.manual_seed(0)
        factory = make_factory({"eye": space}, {"eye": encoder}, actions)
        network = ActorCritic(factory, PolicySettings(hidden_units=8, num_layers=1)).eval()
        torch.nn.init.normal_(network.action_head.weight, std=0.2)
        return Policy(network, Dict({"eye": space}), actions)

    return build


def raw_image() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {"eye": rng.integers(300, 2100, (1, 36, 40), np.uint16)}


def camera_file(**content: Any) -> CameraFile:
    focal = {"fx": 36.0, "fy": 39.0, "cx": 20.5, "cy": 16.5}  # as in training
    return CameraFile.model_validate({"intrinsics": focal, **content})


def test_raw_images_get_the_actions_of_what_is_seen_of_them(make: Make) -> None:
    policy, raw = make(), raw_image()
    expected, _ = policy.predict(SENSOR.take(raw["eye"])[..., None])
    outputs = fit(policy, Deployment()).run(raw)
    np.testing.assert_allclose(outputs["action"], expected, atol=1e-6)
    finer = {"eye": raw["eye"] * np.uint16(10)}
    np.testing.assert_allclose(
        fit(policy, Deployment(), unit_per_m=10_000.0).run(finer)["action"], expected, atol=1e-6
    )


def test_a_meaning_is_affine_between_the_bounds_of_the_actions(make: Make) -> None:
    outputs = fit(make(), Deployment(meaning=PLACE)).run(raw_image())
    low, high = np.array(list(RANGES.values())).T
    share = (outputs["action"][0] - ACTIONS.low) / (ACTIONS.high - ACTIONS.low)
    np.testing.assert_allclose(outputs["place"][0], low + share * (high - low), atol=1e-6)


def test_a_real_camera_is_one_that_was_trained_with(make: Make) -> None:
    focal = {"fx": REAL.fx, "fy": REAL.fy, "cx": REAL.cx, "cy": REAL.cy}
    told = fit(make(), Deployment(), camera_file(intrinsics=focal)).run(raw_image())["action"]
    trained = DepthImage(10, 12, (0.4, 2.0), pinhole=SENSOR.pinhole(REAL), sampling=SENSOR)
    expected = fit(make(trained), Deployment()).run(raw_image())["action"]
    np.testing.assert_allclose(told, expected, atol=1e-6)
    assert not np.allclose(told, fit(make(), Deployment()).run(raw_image())["action"])
    bent = camera_file(intrinsics=focal, distortion={"k1": 0.2})
    assert not np.allclose(fit(make(), Deployment(), bent).run(raw_image())["action"], told)
    assert fit(make(), Deployment(), bent).views["eye"].distortion == Distortion(k1=0.2)


def test_a_place_moves_with_the_camera(make: Make) -> None:
    deployment = Deployment(meaning=PLACE, mounts={"eye": MOUNT})
    told = fit(make(), deployment).run(raw_image())["place"][0]
    # Turned left by a right angle about the world's vertical, and raised by 0.5 m.
    rotation = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    there = camera_file(position_m=(0.0, 0.0, 1.5), rotation=rotation)
    outputs = fit(make(), deployment, there).run(raw_image())
    x, y, z, heading = told
    expected = [-(y - 0.2), x - 0.1, z + 0.5, heading + np.pi / 2]
    np.testing.assert_allclose(outputs["place"][0], expected, atol=1e-6)
    assert fit(make(), deployment, camera_file()).run(raw_image())["place"][0] == pytest.approx(
        told
    )


def test_what_does_not_fit_is_the_users_mistake(make: Make) -> None:
    other = camera_file(intrinsics={"fx": 30.0, "fy": 39.0, "cx": 20.5, "cy": 16.5})
    with pytest.raises(UserError, match=r"encoder of 'eye' \(Conv\) knows no rays"):
        fit(make(encoder=CONV), Deployment(), other)
    assert fit(make(encoder=CONV), Deployment(), camera_file()).views  # the same camera is none
    with pytest.raises(UserError, match="sees no camera's images"):
        fit(make(Box(0, 255, (10, 12, 3), np.uint8), CONV), Deployment(), other)
    with pytest.raises(UserError, match="observation: ear, where the policy sees the images eye"):
        fit(make(), Deployment(), camera_file(observation="ear"))
    with pytest.raises(UserError, match="--camera: a sensor of 80x36"):
        fit(make(), Deployment(), camera_file(width=80))
    there = camera_file(position_m=(0.0, 0.0, 1.5), target_m=(1.0, 0.0, 1.5))
    with pytest.raises(UserError, match="place in training is known and whose actions are places"):
        fit(make(), Deployment(meaning=PLACE), there)
    with pytest.raises(UserError, match=r"--camera: the camera is tilted by 90\.0 deg"):
        fit(make(), Deployment(meaning=PLACE, mounts={"eye": MOUNT}), there)


def test_names_are_given_once(make: Make, make_factory: Callable[..., NetworkFactory]) -> None:
    spaces = {"action": Box(-1.0, 1.0, (2,), np.float32)}
    network = ActorCritic(make_factory(spaces), PolicySettings(hidden_units=4))
    policy = Policy(network, Dict(spaces), Box(-1.0, 1.0, (1,), np.float32))
    with pytest.raises(UserError, match="have the same name"):
        fit(policy, Deployment())


def test_colors_have_no_unit_and_no_intrinsics_of_training(make: Make) -> None:
    color = RgbImage(10, 12, SENSOR)
    with pytest.raises(UserError, match="knows no rays"):
        fit(make(color, CONV), Deployment(), camera_file())
