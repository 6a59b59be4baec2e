"""The blocks: L, U and parallelepiped faces made of rectangles, and where to grasp them.

A block's body frame has its origin at the bottom of the face's middle; x points into the block
(away from the robot), y to the left along the face, z up. The face is the plane x = 0. The U stands
on its two legs and the L on its one, so that the bar, where the largest disc fits, is on top: a
wrist that grasps a small block there stays clear of the support.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled

Floats = NDArray[np.float64]

PARALLELEPIPED, L_SHAPE, U_SHAPE = 0, 1, 2
SHAPE_CODES = {"parallelepiped": PARALLELEPIPED, "L": L_SHAPE, "U": U_SHAPE}

# A cup of 60 mm seals with its rim on the face also when it sits 10 mm beside the grasp point.
DISC_RADIUS_M = 0.04
# The largest disc of a bar that meets a leg is never smaller than half the bar's thickness.
MIN_BAR_M = 2.0 * DISC_RADIUS_M
MAX_BAR_SHARE = 0.5
# From half the width on, an L's centre of mass is over its leg whatever the bar, so that it stands.
L_LEG_SHARE = (0.5, 0.6)
U_LEG_SHARE = (0.25, 0.35)


@compiled()
def largest_corner_disc(leg_m: float, bar_m: float) -> float:
    """Radius of the largest disc where a leg and a bar meet at a right angle.

    It touches both outer sides and the inner corner (leg, bar), so with its centre at (r, r):
    (r - leg)^2 + (r - bar)^2 = r^2, of which the smaller root is meant. Where one of the two is
    more than twice as thick as the other, the disc fills the thick one without reaching the corner.
    """
    thick = max(leg_m, bar_m)
    if thick > 2.0 * min(leg_m, bar_m):
        return thick / 2.0
    return float(leg_m + bar_m - math.sqrt(2.0 * leg_m * bar_m))


@compiled()
def build_block(
    shape: int,
    size_m: Floats,
    bar_m: float,
    leg_share: float,
    leg_on_left: bool,
    center_m: Floats,
    half_m: Floats,
) -> tuple[float, float, float, float]:
    """Builds one block of up to three boxes from its dimensions, all in metres.

    A U has two equal largest discs; the left one (towards +y) is meant, so that an image always
    tells.

    Args:
        shape: PARALLELEPIPED, L_SHAPE or U_SHAPE.
        size_m: (3,) depth, width and height of the whole.
        bar_m: thickness of the bar on top of an L or a U.
        leg_share: in [0, 1], from the narrowest to the widest leg of the shape.
        leg_on_left: on which side an L has its leg.
        center_m: (3, 3) the boxes' centres in the body frame are written here.
        half_m: (3, 3) the boxes' half extents are written here; zeros where there are fewer.

    Returns:
        The centre (y, z) of the largest disc, and the centroid (y, z) of the face.
    """
    depth, width, height = size_m
    center_m[:], half_m[:] = 0.0, 0.0
    top = height if shape == PARALLELEPIPED else bar_m
    center_m[0] = depth / 2, 0.0, height - top / 2
    half_m[0] = depth / 2, width / 2, top / 2
    if shape == PARALLELEPIPED:
        return 0.0, height / 2, 0.0, height / 2
    low, high = L_LEG_SHARE if shape == L_SHAPE else U_LEG_SHARE
    leg = width * (low + (high - low) * leg_share)
    side = 1.0 if leg_on_left or shape == U_SHAPE else -1.0
    for box in range(1, 2 if shape == L_SHAPE else 3):
        center_m[box] = depth / 2, side * (width - leg) / 2, (height - top) / 2
        half_m[box] = depth / 2, leg / 2, (height - top) / 2
    center_m[2, 1] = -center_m[2, 1]
    area = half_m[:, 1] * half_m[:, 2]
    centroid_y = (center_m[:, 1] * area).sum() / area.sum()
    centroid_z = (center_m[:, 2] * area).sum() / area.sum()
    # Where the corner's disc would reach over the far side, the face's smaller side limits it.
    radius = min(largest_corner_disc(leg, bar_m), min(width, height) / 2)
    return side * (width / 2 - radius), height - radius, centroid_y, centroid_z
