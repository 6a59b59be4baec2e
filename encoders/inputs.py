"""The input side of encoders: raw observations to float tensors that a network can take."""

from __future__ import annotations

import math

import numpy as np
import torch
from gymnasium.spaces import Box
from pydantic import BaseModel, Field
from torch import nn
from torch.nn import functional as F

from encoders.spaces import DepthImage, PointCloud, low_and_span

# Farther than any camera sees, and no less exact a number than a depth.
FAR_AWAY_M = 1e4
# Turns metres into 0 or 1, but for a nanometre between them.
STEEP = 1e9


class ImageSettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of every encoder of whole images."""

    validity_channel: bool = Field(
        False,
        description="Depth only: a second channel, 1 where something was seen and 0 elsewhere.",
    )


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
        """Turns the raw numbers into float32, pixel by pixel; here as they are."""
        return raw.to(torch.float32)


class DepthInput(ImageInput):
    """Depth: to metres, which are then scaled to [0, 1] over the range, "nothing seen" to 1.

    Args:
        space: The depth images.
        validity_channel: Append a channel that is 1 where something was seen, otherwise 0.
    """

    def __init__(self, space: DepthImage, validity_channel: bool = False) -> None:
        super().__init__(space)
        self.space, self.validity_channel = space, validity_channel
        self.channels += validity_channel

    def scale(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw depths to [0, 1] over the camera's range, and where they are depths."""
        min_m, max_m = self.space.range_m
        first, span_m = self.space.codes[0], max_m - min_m
        # Straight from the codes and in place, for every pass over all pixels counts. What is
        # beyond the last code needs none of its own: it is clamped with all that is far.
        scaled = raw.to(torch.float32, copy=True)
        F.threshold(scaled, first - 0.5, math.inf, inplace=True)
        scaled.mul_(1.0 / (self.space.codes_per_m * span_m))
        if offset_m := self.space.zero_m - min_m:
            scaled.add_(offset_m / span_m)
        scaled.clamp_(max=1.0)
        if not self.validity_channel:
            return scaled
        return torch.cat([scaled, self.space.seen(raw).float()], dim=-1)


class BoundedInput(ImageInput):
    """Color and any other image: to [0, 1] over the bounds of its space; see `low_and_span`.

    Args:
        space: The images; bounds may differ from pixel to pixel, and from channel to channel.
    """

    _low: torch.Tensor
    _factor: torch.Tensor

    def __init__(self, space: Box) -> None:
        super().__init__(space)
        low, span = low_and_span(space)
        self._starts_at_0 = not low.any()
        self._fits = self._starts_at_0 and bool((span == 1.0).all())
        for name, values in (("_low", low), ("_factor", 1.0 / span)):
            same = (values == values.flat[0]).all()
            scale = torch.tensor(values.flat[0] if same else values, dtype=torch.float32)
            self.register_buffer(name, scale, persistent=False)

    def scale(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw numbers to [0, 1]."""
        if self._fits:
            return super().scale(raw)
        # In place, but never in the raw images: a copy of all pixels costs more than arithmetic.
        scaled = raw.to(torch.float32, copy=True)
        if not self._starts_at_0:
            scaled.sub_(self._low)
        return scaled.mul_(self._factor)


def fill_gaps(depth_m: torch.Tensor) -> torch.Tensor:
    """Fills in pixels where nothing was seen, if they lie between two where something was.

    A pixel is the middle of four lines of three pixels: along the row, the column and the two
    diagonals. The farther end of each counts, and the line with the nearest one is believed: by a
    straight edge there is one that runs along it. So edges stay where they are to half a pixel, no
    depth is made up between the two sides, and no straight border of a region without depths moves.

    Args:
        depth_m: (B, H, W), infinite where nothing was seen.

    Returns:
        (B, H, W), the same where something was seen.
    """
    height, width = depth_m.shape[1:]
    padded = F.pad(depth_m, (1, 1, 1, 1), value=math.inf)

    def farther(down: int, right: int) -> torch.Tensor:
        return torch.maximum(
            padded[:, 1 + down :, 1 + right :][:, :height, :width],
            padded[:, 1 - down :, 1 - right :][:, :height, :width],
        )

    filled = farther(0, 1)
    for down, right in ((1, 0), (1, 1), (1, -1)):
        filled.clamp_(max=farther(down, right))
    return torch.where(depth_m == math.inf, filled, depth_m)


def nearest_surfaces(
    depth_m: torch.Tensor, side: int, thickness_m: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The nearest surface in each cell of an image.

    Args:
        depth_m: (B, H, W), infinite where nothing was seen; H and W are multiples of the side.
        side: of a cell in pixels.
        thickness_m: pixels less than this behind a cell's nearest lie on its surface.

    Returns:
        Three maps (B, H / side, W / side): the mean depth of the surface's pixels, infinite where
        a cell has none; the share of the cell's pixels that lie on it; the share where nothing was
        seen.
    """
    # One plane for each place in a cell: sums over planes are over long rows of memory.
    cells = depth_m.unflatten(2, (-1, side)).unflatten(1, (-1, side))
    pixels = cells.permute(0, 2, 4, 1, 3).flatten(1, 2).clamp(max=FAR_AWAY_M)
    # Clamped numbers in place of comparisons, which take torch five to ten times as long on a CPU.
    behind_m = pixels - pixels.amin(dim=1, keepdim=True)
    on_it = behind_m.sub_(thickness_m).mul_(-STEEP).clamp_(0.0, 1.0)
    count, total_m = on_it.sum(dim=1), (on_it * pixels).sum(dim=1)
    mean_m = total_m / count
    missing = pixels.sub_(FAR_AWAY_M / 2).clamp_(0.0, 1.0).sum(dim=1)
    seen = mean_m < FAR_AWAY_M / 2
    share = 1.0 / side**2
    return mean_m.masked_fill(~seen, math.inf), count * seen * share, missing * share


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


def image_input(space: Box, validity_channel: bool = False) -> ImageInput:
    """Builds the module that turns the raw images of a space into what a convolution takes.

    Depth images become [0, 1] over the camera's range, other bytes and floats over the bounds of
    their space; floats without bounds stay as they are.

    Args:
        space: Images of shape (height, width, channels).
        validity_channel: Of depth images: append a channel that tells which pixels are depths.

    Raises:
        ValueError: The space holds no images, numbers of unknown meaning, or no depth images whose
            pixels could be missing where the channel is asked for.
    """
    if len(space.shape) == 1:
        raise ValueError(
            f"an observation of shape {space.shape} is a vector, not an image (height, width, "
            "channels): use the encoder 'vector' or 'fully_connected'"
        )
    if len(space.shape) != 3:
        raise ValueError(_neither(space))
    if isinstance(space, DepthImage):
        return DepthInput(space, validity_channel)
    if validity_channel:
        raise ValueError(
            "validity_channel: only depth images say where nothing was seen, and these are "
            f"{space}: leave it out"
        )
    if space.dtype == np.uint8 or np.issubdtype(space.dtype, np.floating):
        return BoundedInput(space)
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
    if isinstance(space, PointCloud):
        return f"{space} is of point clouds, neither images nor vectors: use the encoder 'pointnet'"
    return (
        f"an observation of shape {space.shape} is neither a vector (n,) nor an image (height, "
        "width, channels): no encoder takes it; reshape it in the environment"
    )
