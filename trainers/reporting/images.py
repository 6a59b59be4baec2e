"""Observations as pictures for people."""

from __future__ import annotations

from typing import Any

import cv2
import gymnasium
import numpy as np
from numpy.typing import NDArray

from encoders.spaces import DepthImage

MIN_SIDE_PX = 240
BYTE_MAX = 255.0


def picture(space: gymnasium.Space[Any], frame: NDArray[Any]) -> NDArray[np.uint8]:
    """An image observation (H, W, C) as RGB (h, w, 3), enlarged to be seen; near is warm."""
    if isinstance(space, DepthImage):
        scale = {"uint8": 1.0, "uint16": 1000.0}[space.encoding]
        low, high = (0.0, 255.0) if space.encoding == "uint8" else np.multiply(space.range_m, scale)
        nearness = 1.0 - (frame[..., 0].astype(np.float64) - low) / (high - low)
        gray = np.rint(nearness.clip(0.0, 1.0) * 255.0).astype(np.uint8)
        rgb = cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    else:
        rgb = frame[..., :3] if frame.shape[-1] >= 3 else np.repeat(frame[..., :1], 3, axis=-1)
        if np.issubdtype(rgb.dtype, np.floating):
            rgb = np.rint(rgb.clip(0.0, 1.0) * BYTE_MAX)
        rgb = rgb.astype(np.uint8)
    factor = max(1, -(-MIN_SIDE_PX // min(rgb.shape[:2])))
    enlarged = cv2.resize(rgb, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    return np.asarray(enlarged, np.uint8)
