"""Raw values of sensors become observations, and observations raw values that give them again."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st

from encoders.cameras import Sampling
from encoders.raw_inputs import RawInput, raw_input
from encoders.spaces import DepthImage, RgbImage

TAKEN = Sampling(12, 10, 2, 1, 3, 2, 4)
DEPTH = DepthImage(2, 3, (0.4, 2.0), sampling=TAKEN)
BYTES = DepthImage(2, 3, (0.4, 2.0), "uint8", sampling=TAKEN)


def observed(raw_in: RawInput, raw: np.ndarray) -> np.ndarray:
    return raw_in(torch.from_numpy(raw)).numpy()


def test_of_a_sensor_the_pixels_of_the_sampling_are_seen() -> None:
    raw = np.arange(120, dtype=np.uint16).reshape(1, 10, 12)
    seen = observed(raw_input(DEPTH), raw)
    assert seen.dtype == np.uint16
    np.testing.assert_array_equal(seen[0, ..., 0], [[14, 18, 22], [62, 66, 70]])


def test_colors_are_sampled_alike() -> None:
    raw = np.arange(360, dtype=np.uint16).astype(np.uint8).reshape(1, 10, 12, 3)
    seen = observed(raw_input(RgbImage(2, 3, TAKEN)), raw)
    np.testing.assert_array_equal(seen[0], raw[0, 1:6:4, 2:11:4])


@pytest.mark.parametrize("unit", [1000.0, 10_000.0, 5000.0, 1.0])
@given(seed=st.integers(0, 2**31))
def test_observations_come_out_of_the_raw_values_they_are_spread_to(unit: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for space in (DEPTH, BYTES):
        if unit == 1.0:  # whole metres: too coarse for anything but nothing
            codes = np.zeros((2, 2, 3, 1), space.dtype)
        else:
            codes = rng.integers(space.codes[0], space.codes[1] + 1, (2, 2, 3, 1), space.dtype)
            codes[rng.random(codes.shape) < 0.2] = 0
        raw_in = raw_input(space, unit_per_m=unit)
        raw = raw_in.spread(codes)
        assert (raw.shape, raw.dtype) == ((2, *raw_in.shape), raw_in.dtype)
        np.testing.assert_array_equal(observed(raw_in, raw), codes)
    color = rng.integers(0, 256, (2, 2, 3, 3), np.uint8)
    raw_in = raw_input(RgbImage(2, 3, TAKEN))
    np.testing.assert_array_equal(observed(raw_in, raw_in.spread(color)), color)


def test_another_unit_and_another_code_mean_the_same_depths() -> None:
    metres = np.array([[0.0, 0.39, 0.4], [1.2345, 2.0, 2.01]])
    raw = np.zeros((1, 10, 12), np.uint16)
    TAKEN.take(raw)[...] = np.rint(metres * 10_000)
    for space in (DEPTH, BYTES):
        expected = space.encode(np.where(metres == 0.0, np.inf, metres))
        np.testing.assert_array_equal(
            observed(raw_input(space, unit_per_m=10_000.0), raw)[0], expected
        )


def test_another_sensor_may_show_as_many_pixels() -> None:
    finer = Sampling(24, 20, 0, 0, 3, 2, 7)
    raw_in = raw_input(DEPTH, finer)
    assert raw_in.shape == (20, 24)
    raw = np.arange(480, dtype=np.uint16).reshape(1, 20, 24)
    np.testing.assert_array_equal(observed(raw_in, raw)[0, ..., 0], [[0, 7, 14], [168, 175, 182]])
    with pytest.raises(ValueError, match=r"takes 4x2 pixels .* where the network sees 3x2"):
        raw_input(DEPTH, Sampling(24, 20, 0, 0, 4, 2, 5))


def test_what_is_no_camera_is_left_as_it_is() -> None:
    raw_in = raw_input(Box(-1.0, 1.0, (4,), np.float32))
    values = np.linspace(-1, 1, 8, dtype=np.float32).reshape(2, 4)
    np.testing.assert_array_equal(observed(raw_in, values), values)
    np.testing.assert_array_equal(raw_in.spread(values), values)
    with pytest.raises(ValueError, match="holds no images that can be drawn"):
        raw_in.picture(values[0])


def test_the_picture_is_of_the_whole_sensor() -> None:
    raw = np.full((10, 12), 12_000, np.uint16)
    raw[0, 0] = 0
    picture = raw_input(DEPTH, unit_per_m=10_000.0).picture(raw)
    expected = DEPTH.picture(np.full((10, 12, 1), 1200, np.uint16))
    assert (picture[0, 0] == 128).all()
    np.testing.assert_array_equal(picture[1:], expected[1:])
