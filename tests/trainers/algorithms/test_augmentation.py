"""Images shifted at random."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from trainers.algorithms.augmentation import RandomShift, unchanged
from trainers.networks.observations import Observations

HEIGHT_PX, WIDTH_PX = 5, 7


def images(count: int, dtype: type) -> torch.Tensor:
    raw = np.random.default_rng(0).integers(0, 200, (count, HEIGHT_PX, WIDTH_PX, 2))
    return torch.from_numpy((raw * 300 if dtype is np.uint16 else raw).astype(dtype))


@pytest.mark.parametrize("dtype", [np.uint16, np.uint8, np.float32])
def test_every_image_is_a_crop_of_itself_with_repeated_edges(dtype: type) -> None:
    """Against the paper's own words: pad each side by repeating the edge, then crop at random."""
    frames = images(400, dtype)
    index, vectors = torch.arange(400).flip(0), {"x": torch.zeros(400, 1)}
    observations = Observations({"eye": frames}, vectors, index)
    shifted = RandomShift(2, torch.Generator().manual_seed(0))(observations)
    assert shifted.vectors is vectors
    assert shifted.frame_index is index
    assert shifted.frames["eye"].dtype == frames.dtype
    whole = frames.to(torch.float32).permute(0, 3, 1, 2)
    padded = F.pad(whole, (2, 2, 2, 2), mode="replicate").permute(0, 2, 3, 1)
    crops = {
        (y, x): padded[:, y : y + HEIGHT_PX, x : x + WIDTH_PX] for y in range(5) for x in range(5)
    }
    found = torch.zeros(400, dtype=torch.int64)
    for crop in crops.values():
        same = (shifted.frames["eye"].to(torch.float32) == crop).all(dim=(1, 2, 3))
        found += same
        assert 2 <= same.sum() <= 40  # of 16: all shifts come alike
    assert (found == 1).all()


def test_clouds_have_no_pixels_to_be_shifted() -> None:
    cloud = torch.randn(5, 9, 4)
    observations = Observations({"eye": images(5, np.uint8), "cloud": cloud}, {})
    shifted = RandomShift(2, torch.Generator().manual_seed(0))(observations)
    assert shifted.frames["cloud"] is cloud
    assert (shifted.frames["eye"] != observations.frames["eye"]).any()


def test_cameras_are_shifted_apart_and_repeatably() -> None:
    frames = images(50, np.uint8)
    observations = Observations({"left": frames, "right": frames}, {})
    once, again = (
        RandomShift(2, torch.Generator().manual_seed(4))(observations).frames for _ in range(2)
    )
    assert not torch.equal(once["left"], once["right"])
    assert torch.equal(once["left"], again["left"])


def test_no_augmentation_changes_nothing() -> None:
    observations = Observations({"eye": images(2, np.uint8)}, {})
    assert unchanged(observations) is observations
