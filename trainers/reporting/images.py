"""Observations as pictures for people."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import cv2
import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from encoders.spaces import low_and_span

MIN_SIDE_PX = 240
BYTE_MAX = 255.0


@runtime_checkable
class Pictured(Protocol):
    """A space of images that knows how people should see them."""

    def picture(self, frame: NDArray[Any]) -> NDArray[np.uint8]:
        """One observation (H, W, C) as colors (H, W, 3)."""


def picture(space: gymnasium.Space[Any], frame: NDArray[Any]) -> NDArray[np.uint8]:
    """Colors (h, w, 3) of an image observation (H, W, C), enlarged to be seen.

    A space with a method `picture` draws it. Of others the first three channels are the colors, or
    the first one is the gray, over the space's bounds; floats without bounds are shown from 0 to 1.
    """
    colors = space.picture(frame) if isinstance(space, Pictured) else _channels(space, frame)
    factor = max(1, -(-MIN_SIDE_PX // min(colors.shape[:2])))
    enlarged = cv2.resize(colors, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    return np.asarray(enlarged, np.uint8)


def _channels(space: gymnasium.Space[Any], frame: NDArray[Any]) -> NDArray[np.uint8]:
    assert isinstance(space, Box)  # images are
    low, span = low_and_span(space)
    shares = ((frame - low) / span).clip(0.0, 1.0)
    colors = shares[..., :3] if frame.shape[-1] >= 3 else np.repeat(shares[..., :1], 3, axis=-1)
    return np.rint(colors * BYTE_MAX).astype(np.uint8)
