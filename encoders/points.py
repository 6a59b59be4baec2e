"""What the encoders of points share: patches of depths, and moments of the points attended to."""

from __future__ import annotations

import torch
from gymnasium.spaces import Box
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
