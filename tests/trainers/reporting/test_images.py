"""Observations as pictures for people."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.spaces import Box

from encoders.spaces import DepthImage, RgbImage
from trainers.reporting.images import picture


@pytest.mark.parametrize("encoding", ["uint8", "uint16"])
def test_near_is_warm_and_far_is_cold(encoding: str) -> None:
    space = DepthImage(2, 2, (1.0, 40.0), encoding)  # type: ignore[arg-type]
    metres = np.array([[1.0, 40.0], [20.5, 20.5]])
    image = picture(space, space.encode(metres))
    near, far, middle = image[0, 0].astype(int), image[0, -1].astype(int), image[-1, 0].astype(int)
    assert near[0] > 100 > near[2]  # red
    assert far[2] >= far[0]  # blue
    assert middle[1] > max(near[1], far[1])  # green


def test_depths_outside_the_range_look_like_its_ends() -> None:
    space = DepthImage(2, 2, (0.5, 2.0))
    image = picture(space, np.array([[0, 500], [2000, 65535]], np.uint16)[..., None])
    assert (image[0, 0] == image[0, -1]).all()
    assert (image[-1, 0] == image[-1, -1]).all()


def test_colors_stay_as_they_are_and_pixels_become_squares() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (80, 100, 3)).astype(np.uint8)
    image = picture(RgbImage(80, 100), frame)
    assert image.shape == (240, 300, 3)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, frame.repeat(3, 0).repeat(3, 1))


def test_large_images_are_not_enlarged() -> None:
    frame = np.zeros((240, 320, 3), np.uint8)
    assert picture(RgbImage(240, 320), frame).shape == frame.shape


@pytest.mark.parametrize("channels", [1, 2])
def test_other_channels_show_the_first_in_gray(channels: int) -> None:
    frame = np.full((240, 240, channels), 7, np.uint8)
    frame[..., 0] = 100
    image = picture(Box(0, 255, frame.shape, np.uint8), frame)
    assert image.shape == (240, 240, 3)
    assert (image == 100).all()
