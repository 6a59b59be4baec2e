"""The encoder ``keypoints``: a depth image as the 3-D places it consists of."""

from __future__ import annotations

import math
from typing import Literal

import torch
from gymnasium.spaces import Box
from pydantic import BaseModel, Field
from torch import nn

from encoders.inputs import fill_gaps
from encoders.layers import Size, Thickness, dense
from encoders.points import (
    ATTENTION_GAIN,
    COORDINATES,
    MOMENTS,
    UNSEEN,
    PointEncoder,
    attended,
    middles,
    patch_rays,
    patches,
    second_moments,
)


class Keypoints(PointEncoder):
    """Encoder ``keypoints``: depth -> points -> attention -> keypoints in the camera's frame.

    The image is looked at in overlapping patches. Each is described by its shape, which is its
    depths relative to that of its middle, clipped so that an edge is an edge however far the
    background, and by where its middle is: the 3-D point that the camera's intrinsics give. Single
    pixels where nothing was seen are filled in from their neighbours; what is left of them, as
    beyond the camera's range, counts as far away in a patch's shape, and as a middle it is no point
    and gets no attention. Each of K attention maps
    (a softmax over all patches, as in spatial soft-argmax: Levine et al. 2016, arXiv:1504.00702)
    yields the mean of the points it attends to, their covariance (which tells the orientation of
    the surface), and the mean of some learned features.

    Attributes:
        features_dim: K times (3 + 6 + `values`).

    Raises:
        ValueError: The space holds no depth images, does not know its camera, or has images
            smaller than a patch.
    """

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the encoder ``keypoints``."""

        keypoints: Size = Field(24, description="Attention maps, each with a keypoint.")
        patch: int = Field(8, ge=2, description="Side of a patch in pixels.")
        stride: Size = Field(4, description="Pixels from one patch to the next.")
        hidden_units: Size = Field(48, description="Units of the two layers that describe a patch.")
        values: Size = Field(
            8, description="Learned features that a keypoint gathers beside its place."
        )
        precision: Literal["float32", "bfloat16"] = Field(
            "float32",
            description="Numbers that patches are described with; bfloat16 is faster where the "
            "processor knows it. Places are always float32.",
        )
        clip_m: Thickness = Field(
            0.05, description="Depths in a patch count up to so far from its middle's."
        )

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__(space, settings.precision)
        height, width, _ = space.shape
        if min(height, width) < settings.patch:
            raise ValueError(
                f"a {width}x{height} image (width x height) is smaller than a patch of "
                f"{settings.patch} pixels: use a larger image or a smaller patch"
            )
        self._patch, self._stride = settings.patch, settings.stride
        self._clip_m = settings.clip_m
        hidden, count = settings.hidden_units, settings.keypoints
        self.shape = dense(settings.patch**2, hidden, "relu")
        self.place = dense(hidden + COORDINATES, hidden, "relu")
        self.attention = nn.Linear(hidden, count)
        nn.init.normal_(self.attention.weight, std=ATTENTION_GAIN / math.sqrt(hidden))
        nn.init.zeros_(self.attention.bias)
        self.values = nn.Linear(hidden, settings.values)
        self.features_dim = count * (COORDINATES + MOMENTS + settings.values)
        self._know_rays()

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw depth images (B, H, W, 1) -> features (B, features_dim) float32."""
        with torch.no_grad():
            depth_m = fill_gaps(self.space.decode_seen(raw)[..., 0])
            shapes, points, seen = self._look(depth_m)
        with self._precision(raw.device):
            described = self.place(torch.cat([self.shape(shapes), points], dim=-1))
            logits = self.attention(described).masked_fill(~seen[..., None], UNSEEN)
        with torch.autocast(raw.device.type, enabled=False):
            attention = logits.float().softmax(dim=1).transpose(1, 2)
            values = self.values(described.float())
            return attended(attention, points, second_moments(points), values)

    def _look(self, depth_m: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Depths (B, H, W) -> patches' shapes (B, n, p * p), middles (B, n, 3), seen (B, n).

        Depths are infinite where nothing was seen, which in a patch counts as far as can be.
        """
        # In units of the clip: once for each pixel, not for all the patches that it is in.
        of_patches = patches(depth_m * (1.0 / self._clip_m), self._patch, self._stride)
        middle = middles(of_patches)
        seen = middle.isfinite()
        middle = middle.clamp(max=self.space.range_m[1] / self._clip_m)
        shapes = (of_patches - middle[..., None, None]).clamp_(-1.0, 1.0)
        points = self._points(middle * self._clip_m)
        return shapes.flatten(3).flatten(1, 2), points, seen.flatten(1)

    def _patch_rays(self, rays: torch.Tensor) -> torch.Tensor:
        return patch_rays(rays, self._patch, self._stride)
