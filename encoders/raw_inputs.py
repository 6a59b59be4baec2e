"""What a sensor delivers, made into what an encoder takes: sampling, units and codes."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import nn

from encoders.cameras import Sampling
from encoders.spaces import (
    MM_PER_M,
    NOTHING_SEEN,
    ROUNDING,
    UINT16_MAX,
    DepthImage,
    RgbImage,
)


@runtime_checkable
class RayEncoder(Protocol):
    """An encoder of images that knows where the rays of its pixels go."""

    def set_rays(self, rays: NDArray[np.float64]) -> None:
        """Replaces the rays (H, W, 3): the points at depth 1 that the pixels' centres see."""


class RawInput(nn.Module):
    """Raw values of one observation as they come, to observations as its space has them.

    Here nothing is to be done: the raw values of vectors and of images of unknown cameras are the
    observations. Others are made by `raw_input`.

    Args:
        space: of the observation.
        sampling: which of a sensor's pixels are taken; None: the raw image is the observation.

    Attributes:
        space: of the observation.
        sampling: which pixels are taken; None for what is no image of a camera.
        shape: of one raw value, such as (sensor rows, sensor columns).
        dtype: of raw values.
    """

    def __init__(self, space: Box, sampling: Sampling | None = None) -> None:
        super().__init__()
        self.space, self.sampling = space, sampling
        self.shape: tuple[int, ...] = space.shape
        self.dtype: np.dtype[Any] = np.dtype(space.dtype)

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw values (B, *shape) -> observations (B, ...) of the space's shape and type."""
        return raw

    def spread(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Raw values (B, *shape) that `forward` makes these observations (B, ...) of.

        Pixels that are not taken are 0.
        """
        return observations

    def about(self) -> dict[str, Any]:
        """What there is to know of raw values, as plain data."""
        return {"shape": list(self.shape), "dtype": self.dtype.name}

    def picture(self, raw: NDArray[Any]) -> NDArray[np.uint8]:
        """Draws one raw image for people, RGB (rows, columns, 3).

        Raises:
            ValueError: it is no image that people know how to look at.
        """
        if self.shape[2:] != (3,) or self.dtype != np.uint8:
            raise ValueError(f"{self.space} holds no images that can be drawn")
        return np.asarray(raw, np.uint8)


class RawRgb(RawInput):
    """Color images (B, sensor rows, sensor columns, 3) uint8, of which some pixels are taken."""

    sampling: Sampling

    def __init__(self, space: Box, sampling: Sampling) -> None:
        super().__init__(space, sampling)
        self.shape = (sampling.sensor_height, sampling.sensor_width, 3)

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """See `RawInput`."""
        return self.sampling.take(raw.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)

    def spread(self, observations: NDArray[Any]) -> NDArray[Any]:
        """See `RawInput`."""
        raw = np.zeros((len(observations), *self.shape), self.dtype)
        self.sampling.take(np.moveaxis(raw, -1, 1))[...] = np.moveaxis(observations, -1, 1)
        return raw


class RawDepth(RawInput):
    """Depth images (B, sensor rows, sensor columns) uint16; 0 is "nothing seen".

    Args:
        space: of the observation.
        sampling: which pixels are taken.
        unit_per_m: a raw value of so much is one metre.

    Attributes:
        unit_per_m: the same.
    """

    space: DepthImage
    sampling: Sampling

    def __init__(self, space: DepthImage, sampling: Sampling, unit_per_m: float) -> None:
        super().__init__(space, sampling)
        self.shape = (sampling.sensor_height, sampling.sensor_width)
        self.dtype = np.dtype(np.uint16)
        self.unit_per_m = unit_per_m

    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        """See `RawInput`."""
        taken = self.sampling.take(raw)[..., None]
        if self.space.encoding == "uint16" and self.unit_per_m == MM_PER_M:
            return taken  # the codes as they are
        metres = taken.to(torch.float32) / self.unit_per_m
        return self._codes(metres).to(getattr(torch, self.space.encoding))

    def spread(self, observations: NDArray[Any]) -> NDArray[Any]:
        """See `RawInput`."""
        metres = observations[..., 0] / self.space.codes_per_m + self.space.zero_m
        values = np.rint(metres * self.unit_per_m).clip(0, UINT16_MAX)
        raw = np.zeros((len(observations), *self.shape), self.dtype)
        self.sampling.take(raw)[...] = np.where(observations[..., 0] == NOTHING_SEEN, 0, values)
        return raw

    def about(self) -> dict[str, Any]:
        """See `RawInput`."""
        depths = {"unit_per_m": self.unit_per_m, "range_m": list(self.space.range_m)}
        return {**super().about(), **depths, "nothing_seen": NOTHING_SEEN}

    def picture(self, raw: NDArray[Any]) -> NDArray[np.uint8]:
        """See `RawInput`."""
        with torch.no_grad():
            codes = self._codes(torch.from_numpy(raw.astype(np.float32)) / self.unit_per_m)
        return self.space.picture(codes[..., None].numpy())

    def _codes(self, metres: torch.Tensor) -> torch.Tensor:
        """`DepthImage.encode`, of tensors and as floats; 0 metres is nothing seen."""
        space = self.space
        min_m, max_m = space.range_m
        codes = ((metres - space.zero_m) * space.codes_per_m).round().clamp(*space.codes)
        # The raw value of the range's end may be a hair beyond it in float32.
        seen = (metres > 0) & (metres >= min_m - ROUNDING) & (metres <= max_m + ROUNDING)
        return torch.where(seen, codes, float(NOTHING_SEEN))


def raw_input(
    space: Box, sampling: Sampling | None = None, unit_per_m: float = MM_PER_M
) -> RawInput:
    """The input of an observation.

    Args:
        space: of the observation.
        sampling: which pixels of another sensor than the space's own are taken; None: its own.
        unit_per_m: of depth images.

    Raises:
        ValueError: the sampling is not of the space's size, or a unit is none.
    """
    if not isinstance(space, DepthImage | RgbImage):
        return RawInput(space)
    height, width = space.shape[:2]
    taken = sampling or space.sampling
    if (taken.height, taken.width) != (height, width):
        raise ValueError(
            f"the sampling takes {taken.width}x{taken.height} pixels (width x height) of the "
            f"sensor, where the network sees {width}x{height}"
        )
    if isinstance(space, RgbImage):
        return RawRgb(space, taken)
    return RawDepth(space, taken, unit_per_m)
