"""What the encoders of points share: patches of depths, and moments of the points attended to."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from encoders.spaces import DepthImage

# Coordinates are decimetres, so that the size of a block is near 1.
UNITS_PER_M = 10.0
PLACE_SCALE = 1.0 / 3.0
LARGEST_COVARIANCE = 3.0
# Sharp enough at the start that no two keypoints are the mean of all points.
ATTENTION_GAIN = 4.0
UNSEEN = -1e4  # the logit of what the camera does not see
COORDINATES = 3
MOMENTS = 6


class PointEncoder(nn.Module, ABC):
    """An encoder that describes patches of a depth image, each at the 3-D point of its middle.

    A subclass calls `_know_rays` once it can tell `_patch_rays`.

    Args:
        space: the depth images.
        precision: `float32` or `bfloat16`, of what describes patches.

    Attributes:
        space: the same.
        rays: (h, w, 3) float32 of the patches' middles.

    Raises:
        ValueError: The space holds no depth images, or does not know its camera.
    """

    rays: torch.Tensor

    def __init__(self, space: Box, precision: str) -> None:
        super().__init__()
        self.space = known_camera(space)
        self._lowered = precision == "bfloat16"
        min_m, max_m = self.space.range_m
        self._middle_m = math.sqrt(min_m * max_m)

    @abstractmethod
    def _patch_rays(self, rays: torch.Tensor) -> torch.Tensor:
        """Rays of pixels (H, W, 3) -> those of the patches' middles (h, w, 3)."""

    def set_rays(self, rays: NDArray[np.float64]) -> None:
        """Looks through another camera than the space's.

        Args:
            rays: (H, W, 3) the points at depth 1 that pixels' centres see: x right, y down, z
                forward.
        """
        self.rays.copy_(self._patch_rays(torch.from_numpy(rays).float()))

    def _know_rays(self) -> None:
        height, width, _ = self.space.shape
        assert self.space.pinhole is not None
        rays = torch.from_numpy(self.space.pinhole.rays(height, width)).float()
        self.register_buffer("rays", self._patch_rays(rays), persistent=False)

    def _precision(self, device: torch.device) -> AbstractContextManager[object]:
        # Never switches off what the network around it has chosen.
        return torch.autocast(device.type, torch.bfloat16) if self._lowered else nullcontext()

    def _points(self, depth_m: torch.Tensor) -> torch.Tensor:
        """Depths of middles (B, h, w) -> their points (B, n, 3) around the range's middle."""
        points = depth_m[..., None] * self.rays
        points[..., 2] -= self._middle_m
        return points.mul_(UNITS_PER_M).flatten(1, 2)


def known_camera(space: Box) -> DepthImage:
    """The space, if it holds depth images that know their camera.

    Raises:
        ValueError: it does not.
    """
    if not isinstance(space, DepthImage):
        raise ValueError("only depth images (encoders.spaces.DepthImage) can be turned into points")
    if space.pinhole is None:
        raise ValueError(
            "the depth image does not know its camera: declare its DepthImage with a pinhole"
        )
    return space


def patches(images: torch.Tensor, side: int, stride: int) -> torch.Tensor:
    """Images (B, H, W) -> their overlapping patches (B, h, w, side, side)."""
    padding = max(side - stride, 0) // 2
    padded = F.pad(images[:, None], (padding,) * 4, mode="replicate")[:, 0]
    return padded.unfold(1, side, stride).unfold(2, side, stride)


def middles(of_patches: torch.Tensor) -> torch.Tensor:
    """The pixels (...) in the middles of patches (..., p, p)."""
    side = of_patches.shape[-1]
    return of_patches[..., side // 2, side // 2]


def patch_rays(rays: torch.Tensor, side: int, stride: int) -> torch.Tensor:
    """Rays of pixels (H, W, 3) -> those of patches' middles (h, w, 3)."""
    return middles(patches(rays.permute(2, 0, 1), side, stride)).movedim(0, -1).contiguous()


def second_moments(points: torch.Tensor) -> torch.Tensor:
    """Products of coordinates: (..., 3) -> (..., 6): xx, xy, xz, yy, yz, zz."""
    rows, columns = torch.triu_indices(COORDINATES, COORDINATES, device=points.device)
    return points[..., rows] * points[..., columns]


def attended(
    attention: torch.Tensor, points: torch.Tensor, squares: torch.Tensor, values: torch.Tensor
) -> torch.Tensor:
    """What K attention maps see, in numbers of size 1.

    Args:
        attention: (B, K, n), each of sum 1.
        points: (B, n, 3) in units of `UNITS_PER_M`.
        squares: (B, n, 6) their `second_moments`.
        values: (B, n, v) anything else to be averaged.

    Returns:
        (B, K * (3 + 6 + v)): all mean points, then all covariances, then all mean values.
    """
    rows, columns = torch.triu_indices(COORDINATES, COORDINATES, device=points.device)
    means = attention @ torch.cat([points, squares, values], dim=-1)
    place, square, value = means.split([COORDINATES, MOMENTS, values.shape[-1]], dim=-1)
    # Cov(x, y) = E[x y] - E[x] E[y]
    covariance = square - place[..., rows] * place[..., columns]
    bounded = covariance.clamp(-LARGEST_COVARIANCE, LARGEST_COVARIANCE)
    return torch.cat([part.flatten(1) for part in (place * PLACE_SCALE, bounded, value)], 1)
