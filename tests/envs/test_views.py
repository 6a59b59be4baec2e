"""The camera of a policy's images: where points are in them, and files that say it is another."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from encoders.cameras import Distortion, Pinhole, Sampling
from encoders.spaces import DepthImage
from envs.deployment import Mount
from envs.grasp.sensors.camera import pinhole, project, sample_views, sampling
from envs.grasp.settings import Camera, SamplingSettings
from envs.views import CameraFile, View

CAMERA = Camera(
    type="depth",
    width=64,
    height=48,
    fov_deg=(60.0, 49.5),
    sampling=SamplingSettings(crop=(8, 4, 48, 40), every=4),
)
VIEWS = sample_views(CAMERA, np.random.default_rng(0), 1, position_m=0.0, rotation_deg=0.0)
MOUNT = Mount.of(VIEWS.position_m[0], VIEWS.rotation[0])
SPACE = DepthImage(10, 12, pinhole=pinhole(CAMERA), sampling=sampling(CAMERA))
TRAINED = View.of(SPACE, MOUNT)
FOCAL = {"fx": 60.0, "fy": 61.0, "cx": 32.5, "cy": 23.0}


def file(**content: Any) -> CameraFile:
    return CameraFile.model_validate({"intrinsics": FOCAL, **content})


def test_points_are_where_the_simulators_camera_sees_them() -> None:
    points = np.random.default_rng(1).uniform([0.9, -0.3, 0.6], [1.3, 0.3, 0.9], (20, 3))
    found = TRAINED.pixels(points)
    taken = project(VIEWS, points[None])[0, :, :2]  # in pixels of the image as it is sampled
    expected = (taken - 0.5) * 4 + 0.5 + [8, 4]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_what_can_not_be_placed_is_not() -> None:
    behind = np.array([[-5.0, 0.0, 1.0]])
    assert TRAINED.pixels(behind) is None
    assert View.of(SPACE, None).pixels(behind) is None


def test_rays_are_those_of_training_or_of_the_file() -> None:
    np.testing.assert_allclose(TRAINED.rays(), pinhole(CAMERA).rays(10, 12), atol=1e-12)
    lens = Distortion(k1=0.1, p2=0.01)
    bent = file(distortion={"k1": 0.1, "p2": 0.01}).view(TRAINED)
    every_pixel = lens.undistorted(Pinhole(**FOCAL).rays(48, 64))
    np.testing.assert_allclose(bent.rays(), every_pixel[4:44:4, 8:56:4], atol=1e-9)


def test_a_point_is_seen_by_the_pixel_whose_ray_goes_there() -> None:
    bent = file(distortion={"k1": 0.1, "p2": 0.01}).view(TRAINED)
    points = bent.rays()[3, 5] * 1.5 @ np.array(MOUNT.rotation).T + MOUNT.position_m
    np.testing.assert_allclose(bent.pixels(points[None]), [[8 + 4 * 5 + 0.5, 4 + 4 * 3 + 0.5]])


def test_what_a_file_leaves_out_is_as_in_training() -> None:
    view = file().view(TRAINED)
    assert view == TRAINED.model_copy(update={"pinhole": Pinhole(**FOCAL)})


def test_a_file_says_where_the_camera_is() -> None:
    at = {"position_m": CAMERA.position_m}
    looking = file(**at, target_m=CAMERA.target_m).view(TRAINED).mount
    turned = file(**at, rotation=np.round(MOUNT.rotation, 4).tolist()).view(TRAINED).mount
    for mount, tolerance in ((looking, 1e-12), (turned, 1e-4)):
        assert mount is not None
        np.testing.assert_allclose(mount.rotation, MOUNT.rotation, atol=tolerance)
        np.testing.assert_allclose(mount.position_m, MOUNT.position_m)
    rotation = np.array(turned.rotation)  # rounded in the file, and a rotation none the less
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_another_sensor_says_which_of_its_pixels_are_seen() -> None:
    larger = {"width": 128, "height": 96}
    with pytest.raises(ValueError, match=r"128x96 .* trained for 64x48: say with sampling"):
        file(**larger).view(TRAINED)
    with pytest.raises(ValueError, match=r"takes 16x12 pixels .* the network sees 12x10"):
        file(**larger, sampling={"every": 8}).view(TRAINED)
    view = file(**larger, sampling={"crop": [0, 0, 96, 80], "every": 8}).view(TRAINED)
    assert view.sampling == Sampling(128, 96, 0, 0, 12, 10, 8)
    assert replace(view.sampling) == view.sampling


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"intrinsics": None}, "intrinsics"),
        ({"fov_deg": 60.0}, "fov_deg"),
        ({"position_m": [0, 0, 1]}, "position_m goes with target_m or rotation"),
        ({"target_m": [0, 0, 1]}, "position_m goes with target_m or rotation"),
        ({"position_m": [0, 0, 1], "target_m": [0, 0, 1]}, "it looks nowhere"),
        ({"position_m": [0, 0, 1], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation is"),
        ({"position_m": [0, 0, 1], "rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "rotation is"),
        ({"unit_per_m": 0}, "unit_per_m"),
    ],
)
def test_files_that_say_no_camera_are_refused(content: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        file(**content)
