"""What is dark or shiny in a scene, where a structured-light camera sees little."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.cameras import yaw_rotations
from envs.grasp.sensors.structured_light import StructuredLight
from envs.grasp.settings import GraspSettings

Floats = NDArray[np.float64]

# A box reaches so far beyond the surfaces it holds, so that rounding leaves none of them outside.
MARGIN_M = 0.002
PATCH_HALF_M = (0.02, 0.08)


def draw_dark(
    sensor: StructuredLight,
    settings: GraspSettings,
    rng: np.random.Generator,
    block_boxes: tuple[Floats, Floats],
    position_m: Floats,
    yaw_rad: Floats,
) -> tuple[Floats, Floats]:
    """Draws the dark boxes of n scenes: each block's, and some patches'.

    Args:
        sensor: how many are dark, and how dark.
        settings: where patches may be.
        rng: the source of randomness.
        block_boxes: centres and half extents (n, B, 3, 3) of the blocks' boxes in body frames.
        position_m: (n, B, 3) the blocks' origins.
        yaw_rad: (n, B) their yaws.

    Returns:
        Boxes (n, B + P, 4, 3), see `CameraPoses.dark`, and the shares (n, B + P) of the pixels that
        are missing on them, 0 where nothing is dark.
    """
    n, blocks = yaw_rad.shape
    patches, randomize = sensor.dark_patches, settings.randomize
    center, half = _hulls(*block_boxes)
    x, y = randomize.block_x_m, randomize.block_y_m
    z = (settings.support.top_m, settings.support.top_m + randomize.block_size_m[1])
    places = [rng.uniform(*ends, (n, patches, 1)) for ends in (x, y, z)]
    boxes = np.concatenate(
        [
            _boxes(yaw_rotations(yaw_rad), center, half + MARGIN_M, position_m),
            _boxes(
                yaw_rotations(rng.uniform(0.0, np.pi, (n, patches))),
                np.zeros((n, patches, 3)),
                rng.uniform(*PATCH_HALF_M, (n, patches, 3)),
                np.concatenate(places, axis=2),
            ),
        ],
        axis=1,
    )
    is_dark = np.concatenate(
        [
            rng.random((n, blocks)) < sensor.dark_blocks,
            np.arange(patches) < rng.integers(0, patches + 1, (n, 1)),
        ],
        axis=1,
    )
    return boxes, is_dark * rng.uniform(*sensor.dark_missing, (n, blocks + patches))


def _hulls(center_m: Floats, half_m: Floats) -> tuple[Floats, Floats]:
    """Centres and half extents (n, B, 3) of the boxes about the blocks' boxes (n, B, k, 3)."""
    low = np.where(half_m > 0.0, center_m - half_m, np.inf).min(axis=2)
    high = np.where(half_m > 0.0, center_m + half_m, -np.inf).max(axis=2)
    return (low + high) / 2, (high - low) / 2


def _boxes(rotation: Floats, center_m: Floats, half_m: Floats, origin_m: Floats) -> Floats:
    """(n, K, 4, 3): centres, and axes over half extents, in the world frame."""
    middle = origin_m + (rotation @ center_m[..., None])[..., 0]
    axes = np.swapaxes(rotation, -1, -2) / half_m[..., None]
    return np.concatenate([middle[..., None, :], axes], axis=-2)
