"""Frames as an animated GIF, which TensorBoard, browsers and mail show as they are."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

LEAST_MS = 20
"""Of a frame: browsers slow down what is faster."""


def animated_gif(frames: NDArray[np.uint8], fps: float) -> bytes:
    """A GIF that runs for ever.

    Args:
        frames: in color (T, height, width, 3), one or more.
        fps: frames a second; GIF counts in hundredths of a second, and 50 are the most.
    """
    images = [Image.fromarray(frame).quantize(dither=Image.Dither.NONE) for frame in frames]
    duration_ms = max(LEAST_MS, 10 * round(100.0 / fps))
    file = io.BytesIO()
    images[0].save(
        file, "GIF", save_all=True, append_images=images[1:], duration=duration_ms, loop=0
    )
    return file.getvalue()
