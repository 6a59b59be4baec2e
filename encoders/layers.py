"""Parts that the encoders share: sizes of feature maps, convolutions, dense layers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, TypeVar

from gymnasium.spaces import Box
from pydantic import Field
from torch import nn

Activation = Literal["relu", "elu", "leaky_relu", "tanh"]
ConvLayer = tuple[int, int, int]
"""Filters, kernel (pixels), stride (pixels)."""
Size = Annotated[int, Field(ge=1, le=2**16)]
"""Settings: a width, a number of filters, a length in pixels."""
Depth = Annotated[int, Field(ge=1, le=100)]
"""Settings: a number of layers."""
Thickness = Annotated[float, Field(ge=1e-4, le=100.0)]
"""Settings: a difference of depths in metres, from that of a camera's step to that of its range."""
Window = tuple[int, int]
"""Kernel and stride (pixels) of anything that slides over an image without padding."""

_Layer = TypeVar("_Layer", nn.Conv2d, nn.Linear)

ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "leaky_relu": nn.LeakyReLU,
    "tanh": nn.Tanh,
}


def output_length(length: int, windows: Sequence[Window]) -> int:
    """Length in pixels, along one axis, of what the windows leave of a large enough image."""
    for kernel, stride in windows:
        length = (length - kernel) // stride + 1
    return length


def smallest_length(windows: Sequence[Window]) -> int:
    """Smallest length in pixels, along one axis, of which the windows leave one pixel."""
    length = 1
    for kernel, stride in reversed(windows):
        length = (length - 1) * stride + kernel
    return length


def feature_map_area(space: Box, windows: Sequence[Window], network: str) -> int:
    """Counts the pixels of the feature map that the windows leave of an image.

    Args:
        space: Images of shape (height, width, channels).
        windows: Kernels and strides, from the image inwards.
        network: What the user knows the network as, for the message.

    Raises:
        ValueError: The image is too small.
    """
    height, width, _ = space.shape
    least = smallest_length(windows)
    if min(height, width) < least:
        raise ValueError(
            f"a {width}x{height} image (width x height) is too small for {network}: at least "
            f"{least}x{least} is needed; use a larger image, or the encoder 'conv' with fewer "
            "layers, smaller kernels or smaller strides"
        )
    return output_length(height, windows) * output_length(width, windows)


def convolutions(
    channels: int, layers: Sequence[ConvLayer], activation: Activation
) -> nn.Sequential:
    """Builds convolutions without padding, each followed by the activation.

    Maps (B, channels, H, W) to (B, filters of the last layer, h, w).
    """
    stack = nn.Sequential()
    for filters, kernel, stride in layers:
        stack.append(_initialize(nn.Conv2d(channels, filters, kernel, stride), activation))
        stack.append(ACTIVATIONS[activation]())
        channels = filters
    return stack


def dense(inputs: int, outputs: int, activation: Activation = "leaky_relu") -> nn.Sequential:
    """Builds one fully connected layer and its activation: (B, inputs) -> (B, outputs)."""
    return nn.Sequential(
        _initialize(nn.Linear(inputs, outputs), activation), ACTIVATIONS[activation]()
    )


def _initialize(layer: _Layer, activation: Activation) -> _Layer:
    # He et al. 2015: keeps the signal's size through the layers. The gain of relu serves elu and
    # leaky_relu (slope 0.01) as well.
    nn.init.kaiming_normal_(layer.weight, nonlinearity="tanh" if activation == "tanh" else "relu")
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
