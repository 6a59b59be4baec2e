"""Image spaces that say what their numbers mean: depth in metres, and RGB."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

MM_PER_M = 1000
UINT8_MAX = 255
UINT16_MAX = 65535

DepthEncoding = Literal["uint8", "uint16"]


class DepthImage(Box):
    """Depth images of one camera, of shape (height, width, 1), encoded as integers.

    - ``uint16``: millimetres, as a real depth camera delivers them.
    - ``uint8``: ``value_m = min + value * (max - min) / 255``
      ("Learning to Grasp from 2.5D images", equation *clamp*).

    The space holds every value of its type, because a real camera reports 0 where it sees nothing
    and goes beyond its nominal range; ``decode`` clamps them.

    Args:
        height: Rows of the image.
        width: Columns of the image.
        range_m: Nearest and farthest depth of the camera, in metres.
        encoding: What one number of the image stands for.
        focal_length_px: Of the pinhole camera, whose axis goes through the image's middle, for
            encoders that need to know it; None where it is unknown.

    Raises:
        ValueError: The size, the range or the encoding makes no sense.
    """

    def __init__(
        self,
        height: int,
        width: int,
        range_m: tuple[float, float] = (0.4, 2.0),
        encoding: DepthEncoding = "uint16",
        focal_length_px: float | None = None,
    ) -> None:
        if encoding not in ("uint8", "uint16"):
            raise ValueError(f"depth encoding {encoding!r} is unknown: use 'uint16' or 'uint8'")
        _check_size(height, width)
        min_m, max_m = (float(bound) for bound in range_m)
        if not 0 <= min_m < max_m < np.inf:
            raise ValueError(
                f"depth range [{min_m}, {max_m}] m must be finite and rise from 0 or more"
            )
        if encoding == "uint16" and max_m * MM_PER_M > UINT16_MAX:
            raise ValueError(
                f"a depth of {max_m} m does not fit in uint16 millimetres, which end at "
                f"{UINT16_MAX / MM_PER_M} m: lower the range's end or use the encoding 'uint8'"
            )
        if focal_length_px is not None and not 0 < focal_length_px < np.inf:
            raise ValueError(
                f"a focal length of {focal_length_px} pixels must be finite and over 0"
            )
        high, dtype = (UINT8_MAX, np.uint8) if encoding == "uint8" else (UINT16_MAX, np.uint16)
        super().__init__(0, high, shape=(height, width, 1), dtype=dtype)
        self.range_m = (min_m, max_m)
        self.encoding = encoding
        self.focal_length_px = focal_length_px

    def encode(self, metres: NDArray[np.floating]) -> NDArray[np.integer]:
        """Encodes depths as the camera would.

        Args:
            metres: Depths in metres, (..., height, width); infinite where nothing was hit, not NaN.

        Returns:
            Clamped to the range and rounded, (..., height, width, 1), of the space's type.
        """
        min_m, max_m = self.range_m
        values = np.clip(metres, min_m, max_m)
        if self.encoding == "uint8":
            values -= min_m
            values *= UINT8_MAX / (max_m - min_m)
        else:
            values *= MM_PER_M
        return np.rint(values, out=values).astype(self.dtype)[..., np.newaxis]

    def decode(self, raw: torch.Tensor) -> torch.Tensor:
        """Turns raw images into metres, clamped to the range.

        Args:
            raw: Encoded depths of any shape, of the space's type.

        Returns:
            Depths in metres, of the same shape, float32.
        """
        min_m, max_m = self.range_m
        # torch has next to no arithmetic on uint16, so leave it first. What follows is in place: a
        # copy of all pixels for each operation would cost more than the operations.
        metres = raw.float()
        if self.encoding == "uint8":
            # The paper's equation "clamp", as in the docstring of the class.
            metres.mul_((max_m - min_m) / UINT8_MAX).add_(min_m)
        else:
            metres.div_(MM_PER_M)
        return metres.clamp_(min_m, max_m)

    def __eq__(self, other: Any) -> bool:
        """Two depth spaces are equal when their numbers mean the same, too."""
        return isinstance(other, DepthImage) and super().__eq__(other) and self._key == other._key

    def __hash__(self) -> int:
        """Agrees with equality."""
        return hash((self.shape, self._key))

    def __repr__(self) -> str:
        """Says what the numbers mean, where a Box would list its bounds."""
        height, width, _ = self.shape
        camera = "" if self.focal_length_px is None else f", focal_length_px={self.focal_length_px}"
        return (
            f"DepthImage({height}, {width}, range_m={self.range_m}, encoding={self.encoding!r}"
            f"{camera})"
        )

    @property
    def _key(self) -> tuple[tuple[float, float], str, float | None]:
        return self.range_m, self.encoding, self.focal_length_px


class RgbImage(Box):
    """Color images of one camera, uint8, of shape (height, width, 3).

    Args:
        height: Rows of the image.
        width: Columns of the image.

    Raises:
        ValueError: The size makes no sense.
    """

    def __init__(self, height: int, width: int) -> None:
        _check_size(height, width)
        super().__init__(0, UINT8_MAX, shape=(height, width, 3), dtype=np.uint8)

    def __repr__(self) -> str:
        """Gives the size; everything else is fixed."""
        return f"RgbImage({self.shape[0]}, {self.shape[1]})"


def _check_size(height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise ValueError(
            f"an image needs at least one pixel, not {width}x{height} (width x height)"
        )
