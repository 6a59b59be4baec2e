"""The encoder ``second_look``: a depth image as 3-D places, looked at twice."""

from __future__ import annotations

import math
from typing import Literal

import torch
from gymnasium.spaces import Box
from pydantic import BaseModel, Field
from torch import nn

from encoders.inputs import nearest_surfaces
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
from encoders.spaces import DepthImage

# What is known of a cell: depth, coverage, how much of it is missing.
CHANNELS = 3
# So many images' patches stay in a processor's cache: measured with batches of 128 and 256.
IMAGES_AT_ONCE = 64


class SecondLook(PointEncoder):
    """Encoder ``second_look``: depth -> surfaces -> patches -> attention, twice -> features.

    Made for images with holes and ragged edges. Pixels are gathered into cells. Of each it is known
    how far its nearest surface is (the mean of the pixels that lie on it, so that noise and steps
    fall), how much of the cell it covers (which tells where an edge is to a fraction of a cell),
    and how much of the cell is missing. Overlapping patches of cells are described by their shape,
    which are these three, depths relative to the middle cell's, and by the 3-D point of the middle.

    The first look is that of the encoder ``keypoints``: learned maps of attention, the same for all
    images, each of which yields the mean and the covariance of the points it attends to, and the
    mean of learned features. What the first look has found then says where the second one looks:
    its maps of attention have queries that are computed from the first look's features, over what
    describes a patch, its place and the products of its coordinates. So the second look can dwell
    on one thing and ignore its like elsewhere (cross-attention: Vaswani et al. 2017,
    arXiv:1706.03762; the queries from a first pass over the image as in Carion et al. 2020,
    arXiv:2005.12872).

    Attributes:
        features_dim: all maps of attention times (3 + 6 + `values`).

    Raises:
        ValueError: The space holds no depth images, does not know its camera, or has images
            smaller than a patch.
    """

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the encoder ``second_look``."""

        cell: Size = Field(5, description="Side of a cell in pixels.")
        surface_m: Thickness = Field(
            0.03, description="Pixels of a cell's surface lie so far from its nearest."
        )
        patch: int = Field(5, ge=2, description="Side of a patch in cells.")
        stride: Size = Field(2, description="Cells from one patch to the next.")
        clip_m: Thickness = Field(
            0.05, description="Depths in a patch count up to so far from its middle's."
        )
        hidden_units: Size = Field(96, description="Units of the two layers that describe a patch.")
        values: Size = Field(
            16, description="Learned features that a keypoint gathers beside its place."
        )
        first_keypoints: Size = Field(16, description="Attention maps of the first look.")
        second_keypoints: Size = Field(24, description="Attention maps of the second look.")
        query_units: Size = Field(
            64, description="Units of the layer that turns the first look into queries."
        )
        logit_std: float | None = Field(
            None,
            ge=0.01,
            le=100.0,
            description="Logits of a map of the second look are scaled down where their standard "
            "deviation over an image's patches is over this. Without it a map may harden on one "
            "patch, where it has no gradient any more. null: as they are.",
        )
        normalize_queries: bool = Field(
            False,
            description="Standardise each image's features of the first look before queries are "
            "computed from them.",
        )
        precision: Literal["float32", "bfloat16"] = Field(
            "float32",
            description="Numbers that patches are described with; bfloat16 is faster where the "
            "processor knows it. Places are always float32.",
        )

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__(space, settings.precision)
        self._settings = settings
        self._cells = _cells(self.space, settings)
        hidden, first = settings.hidden_units, settings.first_keypoints
        self.shape = dense(CHANNELS * settings.patch**2, hidden, "relu")
        self.place = dense(hidden + COORDINATES, hidden, "relu")
        self.attention = nn.Linear(hidden, first)
        nn.init.normal_(self.attention.weight, std=ATTENTION_GAIN / math.sqrt(hidden))
        nn.init.zeros_(self.attention.bias)
        self.values = nn.Linear(hidden, settings.values)
        each = COORDINATES + MOMENTS + settings.values
        self.queries = Queries(first * each, settings)
        self.second_values = nn.Linear(hidden, settings.values)
        self.features_dim = (first + settings.second_keypoints) * each
        self._know_rays()

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw depth images (B, H, W, 1) -> features (B, features_dim) float32."""
        if raw.device.type != "cpu" or torch.compiler.is_exporting():
            return self._encode(raw)
        return torch.cat([self._encode(part) for part in raw.split(IMAGES_AT_ONCE)])

    def _encode(self, raw: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            shapes, points, unseen = self._look(self.space.decode_seen(raw)[..., 0])
            squares = second_moments(points)
        with self._precision(raw.device):
            described = self.place(torch.cat([self.shape(shapes), points], dim=-1))
            logits = self.attention(described)
            values, second_values = self.values(described), self.second_values(described)
        with torch.autocast(raw.device.type, enabled=False):
            first = attended(_weights(logits.float(), unseen), points, squares, values.float())
            described_queries, place_queries = self.queries(first)
        with self._precision(raw.device):
            logits = described @ described_queries
        with torch.autocast(raw.device.type, enabled=False):
            places = torch.cat([points, squares / COORDINATES], dim=-1) @ place_queries
            logits = self._bounded(logits.float() + places, unseen)
            attention = _weights(logits, unseen)
            return torch.cat(
                [first, attended(attention, points, squares, second_values.float())], dim=1
            )

    def _bounded(self, logits: torch.Tensor, unseen: torch.Tensor) -> torch.Tensor:
        """Logits (B, n, K) of no more than `logit_std` over the patches that were seen."""
        limit = self._settings.logit_std
        if limit is None:
            return logits
        seen = (~unseen).to(logits.dtype)
        share = seen / seen.sum(dim=1, keepdim=True).clamp(min=1.0)
        centred = logits - (share * logits).sum(dim=1, keepdim=True)
        variance = (share * centred.square()).sum(dim=1, keepdim=True)
        return centred * (limit * variance.clamp(min=limit**2).rsqrt())

    def _look(self, depth_m: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Depths (B, H, W) -> shapes (B, n, 3 * p * p), middles (B, n, 3), unseen (B, n, 1)."""
        settings = self._settings
        high, wide = self._cells
        depth_m = depth_m[:, : high * settings.cell, : wide * settings.cell]
        surface_m, coverage, missing = nearest_surfaces(depth_m, settings.cell, settings.surface_m)
        # In units of the clip: once for each cell, not for all the patches that it is in.
        of_patches = self._patches(surface_m * (1.0 / settings.clip_m))
        middle = middles(of_patches)
        unseen = middle.isinf()
        middle = middle.clamp(max=self.space.range_m[1] / settings.clip_m)
        relative = (of_patches - middle[..., None, None]).clamp_(-1.0, 1.0)
        shapes = [part.flatten(3) for part in (relative, *map(self._patches, (coverage, missing)))]
        points = self._points(middle * settings.clip_m)
        return torch.cat(shapes, dim=-1).flatten(1, 2), points, unseen.flatten(1)[..., None]

    def _patches(self, cells: torch.Tensor) -> torch.Tensor:
        return patches(cells, self._settings.patch, self._settings.stride)

    def _patch_rays(self, rays: torch.Tensor) -> torch.Tensor:
        (high, wide), cell = self._cells, self._settings.cell
        whole = rays[: high * cell, : wide * cell]
        of_cells = whole.unflatten(0, (high, cell)).unflatten(2, (wide, cell)).mean(dim=(1, 3))
        return patch_rays(of_cells, self._settings.patch, self._settings.stride)


class Queries(nn.Module):
    """What the second look looks for, from the features (B, F) of the first one."""

    def __init__(self, features_dim: int, settings: SecondLook.Settings) -> None:
        super().__init__()
        self._sizes = [settings.hidden_units, COORDINATES + MOMENTS]
        units, maps = settings.query_units, settings.second_keypoints
        self.standard = nn.LayerNorm(features_dim) if settings.normalize_queries else nn.Identity()
        self.hidden = dense(features_dim, units, "relu")
        self.out = nn.Linear(units, maps * sum(self._sizes))
        # At the start images hardly differ in their queries, and maps do.
        nn.init.normal_(self.out.weight, std=0.5 / math.sqrt(units * sum(self._sizes)))
        nn.init.normal_(self.out.bias, std=0.5 * ATTENTION_GAIN / math.sqrt(settings.hidden_units))

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Queries of what describes a patch (B, hidden units, K) and of its place (B, 9, K)."""
        queries = self.out(self.hidden(self.standard(features))).unflatten(
            1, (-1, sum(self._sizes))
        )
        described, place = queries.transpose(1, 2).split(self._sizes, dim=1)
        return described, place


def _weights(logits: torch.Tensor, unseen: torch.Tensor) -> torch.Tensor:
    """Attention (B, K, n) from logits (B, n, K); none for what was not seen (B, n, 1)."""
    return logits.masked_fill(unseen, UNSEEN).softmax(dim=1).transpose(1, 2)


def _cells(space: DepthImage, settings: SecondLook.Settings) -> tuple[int, int]:
    """How many cells an image is high and wide; pixels that are left over are not looked at."""
    height, width, _ = space.shape
    high, wide = height // settings.cell, width // settings.cell
    if min(high, wide) < settings.patch:
        raise ValueError(
            f"a {width}x{height} image (width x height) is smaller than a patch of "
            f"{settings.patch} cells of {settings.cell} pixels: use a larger image, a smaller "
            "patch or smaller cells"
        )
    return high, wide
