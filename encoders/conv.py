"""Plain convolutional encoders: freely chosen layers, and the networks of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from gymnasium.spaces import Box
from pydantic import Field
from torch import nn

from encoders.inputs import ImageSettings, image_input
from encoders.layers import Activation, ConvLayer, Size, convolutions, feature_map_area

_FIRST_80: tuple[ConvLayer, ...] = ((16, 8, 4), (32, 4, 2))
_FIRST_128: tuple[ConvLayer, ...] = (*_FIRST_80, (64, 2, 1))

PAPER_LAYERS: dict[int, tuple[ConvLayer, ...]] = {
    32: ((4, 2, 4), (8, 1, 2)),
    80: _FIRST_80,
    128: _FIRST_128,
    256: (*_FIRST_128, (72, 2, 1)),
}
"""Layers of "Learning to Grasp from 2.5D images", by the side in pixels of its images."""


class ConvolutionalEncoder(nn.Module):
    """Image -> convolutions -> flattened feature map; the policy's trunk follows.

    Args:
        space: Images of shape (height, width, channels).
        layers: (filters, kernel, stride) of each convolution, from the image inwards.
        activation: What follows each convolution.
        validity_channel: See `ImageSettings`.

    Attributes:
        features_dim: Length of the flattened feature map.

    Raises:
        ValueError: The space holds no images, or images too small for the layers.
    """

    def __init__(
        self,
        space: Box,
        layers: Sequence[ConvLayer],
        activation: Activation,
        validity_channel: bool = False,
    ) -> None:
        super().__init__()
        self.input = image_input(space, validity_channel)
        area = feature_map_area(
            space,
            [(kernel, stride) for _, kernel, stride in layers],
            f"layers {[list(layer) for layer in layers]}",
        )
        self.convolutions = convolutions(self.input.channels, layers, activation)
        self.features_dim = layers[-1][0] * area

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw images (B, H, W, C) -> features (B, features_dim) float32."""
        *layers, activation = self.convolutions
        maps = self.input(raw)
        for layer in layers:
            maps = layer(maps)
        # Flattened first, for the gradient comes from the trunk in that order: an activation whose
        # output lies channels_last would go through the two number by number.
        features: torch.Tensor = activation(maps.flatten(1))
        return features


class Conv(ConvolutionalEncoder):
    """Encoder ``conv``: convolutions as the run file lists them."""

    class Settings(ImageSettings, frozen=True, extra="forbid"):
        """Settings of the encoder ``conv``."""

        layers: Annotated[
            tuple[tuple[Size, Size, Size], ...],
            Field(
                min_length=1,
                description="Convolutions from the image inwards, each [filters, kernel, stride].",
            ),
        ]
        activation: Activation = Field(
            "relu", description="Activation after each convolution: relu, elu, leaky_relu or tanh."
        )

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__(space, settings.layers, settings.activation, settings.validity_channel)


class Paper(ConvolutionalEncoder):
    """Encoder ``paper``: one of the four networks of "Learning to Grasp from 2.5D images"."""

    class Settings(ImageSettings, frozen=True, extra="forbid"):
        """Settings of the encoder ``paper``."""

        size: Literal[32, 80, 128, 256] = Field(
            80,
            description="Side in pixels of the images that the paper used the network for; it "
            "takes images of other sizes, too.",
        )

    def __init__(self, space: Box, settings: Settings) -> None:
        super().__init__(space, PAPER_LAYERS[settings.size], "relu", settings.validity_channel)
