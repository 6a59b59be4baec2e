"""The encoders of Unity ML-Agents: ``simple``, ``nature_cnn``, ``resnet``, ``fully_connected``.

Layers follow mlagents/trainers/torch_entities/encoders.py; every dense layer ends in a leaky ReLU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from gymnasium.spaces import Box
from pydantic import Field
from torch import nn

from encoders.conv import ConvolutionalEncoder
from encoders.inputs import ImageSettings, image_input, vector_input
from encoders.layers import ConvLayer, Depth, Size, dense, feature_map_area


class FeatureSettings(ImageSettings, frozen=True, extra="forbid"):
    """Settings of an encoder that ends in one dense layer."""

    features: Size = Field(256, description="Width of the dense layer the encoder ends in.")


class _ConvolutionsAndDense(nn.Module):
    """Image -> convolutions -> dense layer, with leaky ReLU after each."""

    def __init__(self, space: Box, layers: Sequence[ConvLayer], settings: FeatureSettings) -> None:
        super().__init__()
        self.convolutions = ConvolutionalEncoder(
            space, layers, "leaky_relu", settings.validity_channel
        )
        self.dense = dense(self.convolutions.features_dim, settings.features)
        self.features_dim = settings.features

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw images (B, H, W, C) -> features (B, features_dim) float32."""
        return self.dense(self.convolutions(raw))


class Simple(_ConvolutionsAndDense):
    """Encoder ``simple``: two convolutions and a dense layer; images of at least 20x20.

    Raises:
        ValueError: The space holds no images, or images too small.
    """

    class Settings(FeatureSettings, frozen=True, extra="forbid"):
        """Settings of the encoder ``simple``."""

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__(space, ((16, 8, 4), (32, 4, 2)), settings)


class NatureCnn(_ConvolutionsAndDense):
    """Encoder ``nature_cnn``: the network of Mnih et al. 2015; images of at least 36x36.

    Raises:
        ValueError: The space holds no images, or images too small.
    """

    class Settings(FeatureSettings, frozen=True, extra="forbid"):
        """Settings of the encoder ``nature_cnn``."""

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__(space, ((32, 8, 4), (64, 4, 2), (64, 3, 1)), settings)


class ResidualBlock(nn.Module):
    """Adds to its input what two 3x3 convolutions make of it; the shape (B, C, h, w) stays.

    Args:
        channels: C.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
        )

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """(B, C, h, w) -> (B, C, h, w)."""
        return inputs + self.layers(inputs)


class ResNet(nn.Module):
    """Encoder ``resnet``: the network of IMPALA (Espeholt et al. 2018, figure 3), SiLU inside.

    Three stacks of 16, 32 and 32 channels, each a 3x3 convolution, a maximum over 3x3 with stride 2
    and two residual blocks; then a dense layer. Images of at least 15x15.

    Raises:
        ValueError: The space holds no images, or images too small.
    """

    CHANNELS = (16, 32, 32)
    BLOCKS_PER_STACK = 2
    POOLING = (3, 2)

    class Settings(FeatureSettings, frozen=True, extra="forbid"):
        """Settings of the encoder ``resnet``."""

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__()
        self.input = image_input(space, settings.validity_channel)
        # The convolutions pad, so that the pooling alone makes the image smaller.
        area = feature_map_area(space, [self.POOLING] * len(self.CHANNELS), "the encoder 'resnet'")
        self.stacks = nn.Sequential()
        channels = self.input.channels
        for filters in self.CHANNELS:
            self.stacks.append(nn.Conv2d(channels, filters, 3, padding=1))
            self.stacks.append(nn.MaxPool2d(*self.POOLING))
            self.stacks.extend(ResidualBlock(filters) for _ in range(self.BLOCKS_PER_STACK))
            channels = filters
        self.stacks.append(nn.SiLU())
        self.dense = dense(channels * area, settings.features)
        self.features_dim = settings.features

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw images (B, H, W, C) -> features (B, features_dim) float32."""
        return self.dense(self.stacks(self.input(raw)).flatten(1))


class FullyConnected(nn.Module):
    """Encoder ``fully_connected``: an image or a vector, flattened, through dense layers.

    Raises:
        ValueError: The space holds neither images nor vectors, or has no pixels to be missing.
    """

    class Settings(ImageSettings, frozen=True, extra="forbid"):
        """Settings of the encoder ``fully_connected``."""

        num_layers: Depth = Field(1, description="Number of dense layers.")
        hidden_units: Size = Field(256, description="Width of each dense layer.")

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__()
        is_image, doubled = len(space.shape) == 3, settings.validity_channel
        if doubled and not is_image:
            raise ValueError("validity_channel: a vector has no pixels to be missing: leave it out")
        self.input = image_input(space, doubled) if is_image else vector_input(space)
        width = math.prod(space.shape) * (2 if doubled else 1)
        self.dense = nn.Sequential()
        for _ in range(settings.num_layers):
            self.dense.append(dense(width, settings.hidden_units))
            width = settings.hidden_units
        self.features_dim = width

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw images (B, H, W, C) or vectors (B, n) -> features (B, features_dim) float32."""
        return self.dense(self.input(raw).flatten(1))
