"""The encoder ``pointnet``: a cloud of points, in whatever order they come."""

from __future__ import annotations

from typing import Annotated

import torch
from gymnasium.spaces import Box
from pydantic import BaseModel, Field, PositiveInt
from torch import nn

from encoders.layers import dense
from encoders.points import UNITS_PER_M
from encoders.spaces import COORDINATES, PointCloud

# What so many clouds are described by stays in a processor's cache.
CLOUDS_AT_ONCE = 8


class PointNet(nn.Module):
    """Encoder ``pointnet``: the same layers for every point, then the maximum over all points.

    After Qi et al. 2017 (arXiv:1612.00593), without its learned transformations: each layer ends in
    a ReLU, and each feature is that of the point which has most of it. So neither the order of the
    points nor the number of rows without one makes a difference.

    Attributes:
        features_dim: Units of the last of the layers.

    Raises:
        ValueError: The space holds no point clouds.
    """

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the encoder ``pointnet``."""

        layers: Annotated[
            tuple[PositiveInt, ...],
            Field(
                min_length=1,
                description="Units of the layers that all points share; the last are the features.",
            ),
        ] = (32, 64, 128)

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__()
        if not isinstance(space, PointCloud):
            raise ValueError(
                "the encoder 'pointnet' takes point clouds (encoders.spaces.PointCloud), such as a "
                f"camera of `type: points` delivers, and not {space}: use 'keypoints' or 'conv' "
                "for images, 'vector' for vectors"
            )
        self._middle_m: torch.Tensor
        self.register_buffer("_middle_m", torch.tensor(space.middle_m), persistent=False)
        self.layers = nn.Sequential()
        width = COORDINATES
        for units in settings.layers:
            self.layers.append(dense(width, units, "relu"))
            width = units
        self.features_dim = width

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Clouds (B, P, 4) -> features (B, features_dim) float32; 0 where there is no point."""
        if torch.compiler.is_exporting() or raw.shape[1] <= self.features_dim:
            return self._describe(raw).amax(dim=1)
        with torch.no_grad():
            largest = [self._describe(part).max(dim=1) for part in raw.split(CLOUDS_AT_ONCE)]
        if not torch.is_grad_enabled():
            return torch.cat([part.values for part in largest])
        # The gradient of a maximum is that of one point: only those are described again, which
        # takes a fifth of the time.
        rows = torch.cat([part.indices for part in largest])[..., None].expand(-1, -1, raw.shape[2])
        return self._describe(raw.gather(1, rows)).diagonal(dim1=1, dim2=2)

    def _describe(self, raw: torch.Tensor) -> torch.Tensor:
        """Rows (B, n, 4) -> features of each (B, n, features_dim)."""
        points = (raw[..., :COORDINATES] - self._middle_m) * UNITS_PER_M
        missing = raw[..., COORDINATES:] < 0.5
        # Features are 0 or more: one of 0 is never the largest, unless there is nothing else.
        described: torch.Tensor = self.layers(points)
        return described.masked_fill(missing, 0.0)
