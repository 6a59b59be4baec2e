"""The encoder `mean_pool`."""

import torch
from gymnasium.spaces import Box
from pydantic import BaseModel, Field
from torch import nn

from encoders.inputs import image_input


class MeanPool(nn.Module):
    """The image averaged over the cells of a grid; it has no weights."""

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the encoder `mean_pool`."""

        grid: int = Field(8, ge=1, description="Cells along each side of the image.")

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__()
        self.input = image_input(space)
        self.pool = nn.AdaptiveAvgPool2d(settings.grid)
        self.features_dim = self.input.channels * settings.grid**2

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw images (B, H, W, C) -> features (B, features_dim) float32."""
        return self.pool(self.input(raw)).flatten(1)
