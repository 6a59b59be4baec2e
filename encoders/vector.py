"""The encoder for vectors, such as joint angles or privileged state."""

from __future__ import annotations

import torch
from gymnasium.spaces import Box
from pydantic import BaseModel, Field
from torch import nn

from encoders.inputs import vector_input
from encoders.normalizer import RunningNormalizer


class Vector(nn.Module):
    """Encoder ``vector``: passes vectors on as float32, standardised where the settings say so.

    Attributes:
        features_dim: Length of the vectors.

    Raises:
        ValueError: The space holds no vectors.
    """

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the encoder ``vector``."""

        normalize: bool = Field(
            False, description="Standardise by the mean and variance of all vectors seen so far."
        )

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__()
        self.input = vector_input(space)
        self.features_dim = self.input.size
        self.normalizer = RunningNormalizer(self.features_dim) if settings.normalize else None

    def update_statistics(self, batch: torch.Tensor) -> None:
        """Learns from raw vectors (B, n) how to standardise; does nothing without ``normalize``."""
        if self.normalizer is not None:
            self.normalizer.update(batch)

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw vectors (B, n) -> features (B, n) float32; never changes the statistics."""
        return self.input(raw) if self.normalizer is None else self.normalizer(raw)
