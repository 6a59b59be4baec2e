"""The input side of encoders: raw observations to float tensors that a network can take."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import nn

from encoders.spaces import UINT8_MAX, DepthImage


class ImageInput(nn.Module):
    """Maps raw images (B, H, W, C) to (B, C, H, W) float32.

    Attributes:
        channels: C.
    """

    def __init__(self, space: Box) -> None:
        super().__init__()
        self.channels: int = space.shape[2]

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """(B, H, W, C) of the space's type -> (B, C, H, W) float32."""
        # A view, thus channels_last in memory: measured on two cores with the 80x80 network and
        # batch 512, forward and backward, it ties with a contiguous copy for depth and takes a
        # quarter less time for RGB.
        return self.scale(raw).permute(0, 3, 1, 2)

    def scale(self, raw: torch.Tensor) -> torch.Tensor:
        """Turns the raw numbers into float32, element by element; here as they are."""
        return raw.to(torch.float32)


class DepthInput(ImageInput):
    """Depth: to metres, clamped to the camera's range, which is then scaled to [0, 1]."""

    def __init__(self, space: DepthImage) -> None:
        super().__init__(space)
        self.space = space

    def scale(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw depths to [0, 1] over the camera's range."""
        min_m, max_m = self.space.range_m
        return self.space.decode(raw).sub_(min_m).mul_(1.0 / (max_m - min_m))


class ByteInput(ImageInput):
    """Color and any other image of bytes: to [0, 1]."""

    def scale(self, raw: torch.Tensor) -> torch.Tensor:
        """Bytes to [0, 1]."""
        return raw.to(torch.float32).mul_(1.0 / UINT8_MAX)


class VectorInput(nn.Module):
    """Maps raw vectors (B, n) to float32.

    Attributes:
        size: n.
    """

    def __init__(self, space: Box) -> None:
        super().__init__()
        self.size: int = space.shape[0]

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """(B, n) of the space's type -> (B, n) float32."""
        return raw.to(torch.float32)


def image_input(space: Box) -> ImageInput:
    """Builds the module that turns the raw images of a space into what a convolution takes.

    Depth images become [0, 1] over the camera's range, other bytes [0, 1]; floats stay as they are.

    Args:
        space: Images of shape (height, width, channels).

    Raises:
        ValueError: The space holds no images, or numbers of unknown meaning.
    """
    if len(space.shape) == 1:
        raise ValueError(
            f"an observation of shape {space.shape} is a vector, not an image (height, width, "
            "channels): use the encoder 'vector' or 'fully_connected'"
        )
    if len(space.shape) != 3:
        raise ValueError(_neither(space))
    if isinstance(space, DepthImage):
        return DepthInput(space)
    if space.dtype == np.uint8:
        return ByteInput(space)
    if np.issubdtype(space.dtype, np.floating):
        return ImageInput(space)
    raise ValueError(
        f"images of {space.dtype} do not say how to scale them: declare depth as "
        "encoders.spaces.DepthImage, and others as uint8 or float"
    )


def vector_input(space: Box) -> VectorInput:
    """Builds the module that turns raw vectors into float32.

    Args:
        space: Vectors of shape (n,).

    Raises:
        ValueError: The space holds no vectors.
    """
    if len(space.shape) == 3:
        raise ValueError(
            f"an observation of shape {space.shape} is an image, not a vector: use an image "
            "encoder such as 'conv', or 'fully_connected'"
        )
    if len(space.shape) != 1:
        raise ValueError(_neither(space))
    return VectorInput(space)


def _neither(space: Box) -> str:
    return (
        f"an observation of shape {space.shape} is neither a vector (n,) nor an image (height, "
        "width, channels): no encoder takes it; reshape it in the environment"
    )
