"""Observations as tensors."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from encoders.spaces import DepthImage, PointCloud, RgbImage
from trainers.networks.observations import frames_differ, is_frame, to_tensors

SPACE = gymnasium.spaces.Dict(
    {
        "depth": DepthImage(2, 3, (0.5, 60.0)),
        "color": RgbImage(2, 3),
        "joints": Box(-1.0, 1.0, (4,), np.float32),
    }
)
CPU = torch.device("cpu")


def some_observations(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "depth": rng.integers(32_768, 65_536, (count, 2, 3, 1)).astype(np.uint16),
        "color": rng.integers(0, 256, (count, 2, 3, 3)).astype(np.uint8),
        "joints": rng.uniform(-1, 1, (count, 4)).astype(np.float32),
    }


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (DepthImage(4, 4), True),
        (RgbImage(4, 4), True),
        (Box(0.0, 1.0, (4, 4, 2), np.float32), True),
        (PointCloud(4), True),
        (Box(0.0, 1.0, (4, 4), np.float32), False),
        (Box(0.0, 1.0, (4,), np.float32), False),
        (gymnasium.spaces.Discrete(3), False),
    ],
)
def test_images_and_clouds_are_frames_and_nothing_else_is(
    space: gymnasium.Space[object], expected: bool
) -> None:
    assert is_frame(space) is expected


def test_frames_differ_where_one_number_of_any_of_them_does() -> None:
    first = {"image": np.zeros((4, 2, 3, 1), np.uint8), "cloud": np.zeros((4, 5, 4), np.float32)}
    second = {name: frames.copy() for name, frames in first.items()}
    second["image"][0, 1, 2] = second["cloud"][3, 4, 0] = 1
    found = frames_differ(first, second, first, np.array([0, 1, 3]))
    assert found.tolist() == [True, False, True]
    assert frames_differ(first, second, first, np.array([], np.int64)).tolist() == []


def test_frames_and_vectors_are_told_apart_and_keep_their_values_and_types() -> None:
    raw = some_observations(5)
    tensors = to_tensors(raw, SPACE, CPU)
    assert set(tensors.frames) == {"depth", "color"}
    assert set(tensors.vectors) == {"joints"}
    assert tensors.frame_index is None
    assert tensors.frames["depth"].dtype == torch.uint16  # 32768 and more would not fit in int16
    assert tensors.frames["color"].dtype == torch.uint8
    for name, tensor in (tensors.frames | tensors.vectors).items():
        np.testing.assert_array_equal(tensor.numpy(), raw[name])


def test_rows_choose_and_order() -> None:
    raw = some_observations(5)
    tensors = to_tensors(raw, SPACE, CPU, np.array([3, 0]))
    for name, tensor in (tensors.frames | tensors.vectors).items():
        np.testing.assert_array_equal(tensor.numpy(), raw[name][[3, 0]])


def test_views_that_torch_can_not_take_are_copied() -> None:
    raw = {name: values[::-1] for name, values in some_observations(4).items()}
    tensors = to_tensors(raw, SPACE, CPU)
    np.testing.assert_array_equal(tensors.vectors["joints"].numpy(), raw["joints"])
    np.testing.assert_array_equal(tensors.frames["depth"].numpy(), raw["depth"])
