from __future__ import annotations

from dataclasses import astuple

import cv2
import numpy as np
import pytest
import torch

from encoders.cameras import Distortion, Pinhole, Sampling


def test_rays_go_through_the_centres_of_the_pixels() -> None:
    rays = Pinhole(2.0, 4.0, 1.0, 0.5).rays(2, 3)
    np.testing.assert_allclose(rays[..., 0], [[-0.25, 0.25, 0.75]] * 2)
    np.testing.assert_allclose(rays[..., 1], [[0.0] * 3, [0.25] * 3])
    np.testing.assert_allclose(rays[..., 2], 1.0)


@pytest.mark.parametrize("every", [1, 2, 5])
def test_a_pixel_that_is_taken_keeps_its_ray(every: int) -> None:
    sensor = Pinhole(55.0, 52.0, 31.0, 26.5)
    taken = Sampling(64, 48, 3, 7, 9, 8, every)
    rays = taken.pinhole(sensor).rays(8, 9)
    raw = np.moveaxis(sensor.rays(48, 64), -1, 0)
    np.testing.assert_allclose(np.moveaxis(rays, -1, 0), taken.take(raw), atol=1e-12)


def test_take_works_on_arrays_and_tensors_alike() -> None:
    raw = np.arange(2 * 6 * 8).reshape(2, 6, 8)
    taken = Sampling(8, 6, 1, 2, 3, 2, 3)
    np.testing.assert_array_equal(taken.take(raw)[0], [[17, 20, 23], [41, 44, 47]])
    np.testing.assert_array_equal(taken.take(torch.from_numpy(raw)), taken.take(raw))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((8, 6, 0, 0, 9, 6, 1), r"last pixel is \(8, 5\)"),
        ((8, 6, 1, 0, 3, 3, 3), r"last pixel is \(7, 6\)"),
        ((8, 6, -1, 0, 3, 3, 1), "places at 0"),
        ((8, 6, 0, 0, 3, 3, 0), "start at 1"),
    ],
)
def test_pixels_that_a_sensor_does_not_have_are_refused(fields, message) -> None:
    with pytest.raises(ValueError, match=message):
        Sampling(*fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((0.0, 1.0, 0.0, 0.0), "focal lengths of 0.0 and 1.0"),
        ((1.0, float("inf"), 0.0, 0.0), "inf"),
        ((1.0, 1.0, float("nan"), 0.0), r"axis at \(nan"),
    ],
)
def test_what_is_no_camera_is_refused(fields, message) -> None:
    with pytest.raises(ValueError, match=message):
        Pinhole(*fields)


def test_the_sensors_camera_is_found_again_from_that_of_what_is_taken() -> None:
    sensor, taken = Pinhole(55.0, 52.0, 31.0, 26.5), Sampling(64, 48, 3, 7, 9, 8, 5)
    found = taken.sensor_pinhole(taken.pinhole(sensor))
    np.testing.assert_allclose(astuple(found), astuple(sensor))


LENS = Distortion(k1=0.12, k2=-0.25, p1=0.001, p2=-0.002, k3=0.1)


def test_the_lens_is_opencvs() -> None:
    pinhole = Pinhole(585.0, 580.0, 322.5, 238.0)
    points = np.random.default_rng(0).uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.5], (50, 3))
    seen = LENS.distorted(points / points[:, 2:])
    # OpenCV counts from the middle of the first pixel.
    matrix = np.array([[585.0, 0.0, 322.0], [0.0, 580.0, 237.5], [0.0, 0.0, 1.0]])
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix, np.array(astuple(LENS))
    )
    pixels = seen[:, :2] * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
    np.testing.assert_allclose(pixels, expected[:, 0] + 0.5, atol=1e-9)


def test_what_a_lens_did_is_undone() -> None:
    rays = Pinhole(585.0, 585.0, 320.0, 240.0).rays(480, 640)
    np.testing.assert_allclose(LENS.distorted(LENS.undistorted(rays)), rays, atol=1e-6)
    np.testing.assert_array_equal(Distortion().undistorted(rays), rays)


def test_a_lens_that_folds_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match="can't be undone over the whole image"):
        Distortion(k1=-2.0).undistorted(Pinhole(200.0, 200.0, 320.0, 240.0).rays(480, 640))
