"""The blocks: L, U and parallelepiped faces made of rectangles, and where to grasp them.

A block's body frame has its origin at the bottom of the face's middle; x points into the block
(away from the robot), y to the left along the face, z up. The face is the plane x = 0. The U stands
on its two legs and the L on its one, so that the bar, where the largest disc fits, is on top: a
wrist that grasps a small block there stays clear of the support.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PARALLELEPIPED, L_SHAPE, U_SHAPE = 0, 1, 2
SHAPE_CODES = {"parallelepiped": PARALLELEPIPED, "L": L_SHAPE, "U": U_SHAPE}
BOXES_PER_BLOCK = 3

# A cup of 60 mm seals with its rim on the face also when it sits 10 mm beside the grasp point.
DISC_RADIUS_M = 0.04
# The largest disc of a bar that meets a leg is never smaller than half the bar's thickness.
MIN_BAR_M = 2.0 * DISC_RADIUS_M
MAX_BAR_SHARE = 0.5
L_LEG_SHARE = (0.4, 0.6)
U_LEG_SHARE = (0.25, 0.35)


@dataclass(frozen=True)
class Dimensions:
    """What n blocks are made from; arrays (n,).

    Attributes:
        shape: PARALLELEPIPED, L_SHAPE or U_SHAPE.
        width_m, height_m: of the face.
        depth_m: behind the face.
        bar_m: thickness of the bar on top of an L or a U.
        leg_share: in [0, 1], from the narrowest to the widest leg of the shape.
        leg_on_left: on which side an L has its leg.
    """

    shape: NDArray[np.int64]
    width_m: Floats
    height_m: Floats
    depth_m: Floats
    bar_m: Floats
    leg_share: Floats
    leg_on_left: NDArray[np.bool_]


@dataclass(frozen=True)
class Blocks:
    """n blocks, each up to three boxes in its body frame.

    Attributes:
        center_m: (n, 3, 3) centres of the boxes.
        half_m: (n, 3, 3) half extents; all zero where a block has fewer boxes.
        disc_m: (n, 2) the centre (y, z) of the largest disc on the face.
        centroid_m: (n, 2) the centroid (y, z) of the face.
        size_m: (n, 3) depth, width and height of the whole.
    """

    center_m: Floats
    half_m: Floats
    disc_m: Floats
    centroid_m: Floats
    size_m: Floats


def largest_corner_disc(leg_m: Floats, bar_m: Floats) -> Floats:
    """Radius of the largest disc where a leg and a bar meet at a right angle.

    It touches both outer sides and the inner corner (leg, bar), so with its centre at (r, r):
    (r - leg)^2 + (r - bar)^2 = r^2, of which the smaller root is meant. Where one of the two is
    more than twice as thick as the other, the disc fills the thick one without reaching the corner.
    """
    thin, thick = np.minimum(leg_m, bar_m), np.maximum(leg_m, bar_m)
    in_corner = leg_m + bar_m - np.sqrt(2.0 * leg_m * bar_m)
    return np.where(thick > 2.0 * thin, thick / 2.0, in_corner)


def sample_blocks(
    rng: np.random.Generator,
    shape: NDArray[np.int64],
    size_range_m: tuple[float, float],
    depth_range_m: tuple[float, float],
) -> Blocks:
    """Draws the dimensions of n blocks whose shapes (n,) are given."""
    n = len(shape)
    width, height = rng.uniform(*size_range_m, (2, n))
    return make_blocks(
        Dimensions(
            shape=shape,
            width_m=width,
            height_m=height,
            depth_m=rng.uniform(*depth_range_m, n),
            bar_m=rng.uniform(MIN_BAR_M, np.maximum(MIN_BAR_M, MAX_BAR_SHARE * height)),
            leg_share=rng.random(n),
            leg_on_left=rng.random(n) < 0.5,
        )
    )


def make_blocks(dimensions: Dimensions) -> Blocks:
    """Builds n blocks.

    A U has two equal largest discs; the left one (towards +y) is meant, so that an image always
    tells.
    """
    shape, width, height = dimensions.shape, dimensions.width_m, dimensions.height_m
    depth, bar = dimensions.depth_m, dimensions.bar_m
    is_l, is_u = shape == L_SHAPE, shape == U_SHAPE
    has_bar = is_l | is_u
    low, high = (
        np.where(is_l, L_LEG_SHARE[0], U_LEG_SHARE[0]),
        np.where(is_l, L_LEG_SHARE[1], U_LEG_SHARE[1]),
    )
    leg = width * (low + (high - low) * dimensions.leg_share)
    side = np.where(is_u | dimensions.leg_on_left, 1.0, -1.0)
    top = np.where(has_bar, bar, height)

    center = np.zeros((len(shape), BOXES_PER_BLOCK, 3))
    half = np.zeros_like(center)
    center[:, 0] = np.stack([depth / 2, np.zeros_like(depth), height - top / 2], axis=1)
    half[:, 0] = np.stack([depth, width, top], axis=1) / 2
    leg_center = np.stack([depth / 2, side * (width - leg) / 2, (height - top) / 2], axis=1)
    leg_half = np.stack([depth, leg, height - top], axis=1) / 2
    center[:, 1], half[:, 1] = leg_center, np.where(has_bar[:, None], leg_half, 0.0)
    center[:, 2], half[:, 2] = leg_center * [1, -1, 1], np.where(is_u[:, None], leg_half, 0.0)
    center[half[:, :, 0] == 0.0] = 0.0

    # Where the corner's disc would reach over the far side, the face's smaller side limits it.
    radius = np.minimum(largest_corner_disc(leg, bar), np.minimum(width, height) / 2)
    disc = np.stack([side * (width / 2 - radius), height - radius], axis=1)
    disc = np.where(has_bar[:, None], disc, np.stack([0 * height, height / 2], axis=1))
    area = half[:, :, 1] * half[:, :, 2]
    centroid = (center[:, :, 1:] * area[:, :, None]).sum(1) / area.sum(1, keepdims=True)
    return Blocks(center, half, disc, centroid, np.stack([depth, width, height], axis=1))
