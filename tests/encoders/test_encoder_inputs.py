"""From raw observations to what a network takes."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from encoders.inputs import image_input, vector_input
from encoders.spaces import DepthImage, RgbImage


def test_channels_come_first_and_pixels_stay_in_place():
    raw = torch.zeros(2, 4, 5, 3, dtype=torch.uint8)
    raw[1, 2, 3, 0] = 255
    raw[0, 3, 1, 2] = 51
    images = image_input(RgbImage(4, 5))(raw)
    assert images.shape == (2, 3, 4, 5)
    assert images.dtype == torch.float32
    assert images[1, 0, 2, 3] == 1
    assert images[0, 2, 3, 1] == pytest.approx(0.2)
    assert images.count_nonzero() == 2


def test_depth_is_scaled_over_the_range():
    module = image_input(DepthImage(1, 6))
    raw = torch.from_numpy(np.array([0, 400, 800, 1200, 2000, 65535], dtype=np.uint16))
    scaled = module(raw.reshape(1, 1, 6, 1))
    assert module.channels == 1
    assert scaled.shape == (1, 1, 1, 6)
    assert scaled.flatten().tolist() == pytest.approx([0, 0, 0.25, 0.5, 1, 1], abs=1e-6)


def test_depth_bytes_are_scaled_over_the_range():
    module = image_input(DepthImage(1, 3, (0.5, 0.9), "uint8"))
    scaled = module(torch.tensor([0, 51, 255], dtype=torch.uint8).reshape(1, 1, 3, 1))
    assert scaled.flatten().tolist() == pytest.approx([0, 0.2, 1], abs=1e-6)


def test_floats_stay_as_they_are():
    module = image_input(Box(-np.inf, np.inf, (2, 2, 4), dtype=np.float64))
    raw = torch.randn(3, 2, 2, 4, dtype=torch.float64)
    images = module(raw)
    assert images.dtype == torch.float32
    assert images[2, 3, 0, 1] == raw[2, 0, 1, 3].float()


def test_integers_of_unknown_meaning_are_refused():
    with pytest.raises(ValueError, match=r"uint16.*DepthImage"):
        image_input(Box(0, 65535, (8, 8, 1), dtype=np.uint16))


def test_vectors_become_float32():
    module = vector_input(Box(-1, 1, (3,), dtype=np.float64))
    values = module(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64))
    assert module.size == 3
    assert values.dtype == torch.float32
    assert values.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("build", [image_input, vector_input])
def test_matrices_are_neither_images_nor_vectors(build):
    with pytest.raises(ValueError, match=r"\(4, 5\).*neither"):
        build(Box(-1, 1, (4, 5)))
