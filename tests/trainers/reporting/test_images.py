"""Observations as pictures for people."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.spaces import Box

from encoders.spaces import DepthImage, RgbImage
from trainers.reporting.images import picture


def test_a_space_of_pictures_draws_them_itself() -> None:
    space = DepthImage(2, 3)
    frame = np.array([[0, 500, 900], [2000, 65535, 1200]], np.uint16)[..., None]
    image = picture(space, frame)
    assert image.shape == (240, 360, 3)
    np.testing.assert_array_equal(image[60::120, 60::120], space.picture(frame))


def test_colors_stay_as_they_are_and_pixels_become_squares() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (80, 100, 3)).astype(np.uint8)
    image = picture(RgbImage(80, 100), frame)
    assert image.shape == (240, 300, 3)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, frame.repeat(3, 0).repeat(3, 1))


def test_large_images_are_not_enlarged() -> None:
    frame = np.zeros((240, 320, 3), np.uint8)
    assert picture(RgbImage(240, 320), frame).shape == frame.shape


def test_pictures_go_from_bound_to_bound_or_from_0_to_1_without_bounds() -> None:
    frame = np.float32([[[-1.0], [0.0], [0.5], [3.0]]])
    for bounds, grays in (((-1.0, 3.0), [0, 64, 96, 255]), ((-np.inf, np.inf), [0, 0, 128, 255])):
        image = picture(Box(*bounds, frame.shape, np.float32), frame)
        assert image[0, 120::240, 0].tolist() == grays


@pytest.mark.parametrize("channels", [1, 2])
def test_other_channels_show_the_first_in_gray(channels: int) -> None:
    frame = np.full((240, 240, channels), 7, np.uint8)
    frame[..., 0] = 100
    image = picture(Box(0, 255, frame.shape, np.uint8), frame)
    assert image.shape == (240, 240, 3)
    assert (image == 100).all()
