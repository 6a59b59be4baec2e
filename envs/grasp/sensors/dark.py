"""Holes in what is dark or shiny: a structured-light camera misses a share of its pixels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import NOTHING_SEEN
from envs.grasp.sensors.fields import Field
from envs.grasp.sensors.noise import FAST
from envs.grasp.simulators.kernels.worlds import Floats, dot, kernel, triple

Pixels = NDArray[np.float32]
Codes = NDArray[np.uint16]
Span = tuple[int, int]

# Nearer than this to the camera's plane, a corner has no place in the picture.
MIN_DEPTH_M = 0.01


@kernel()
def darken(
    disparity: Pixels,
    disparity_m: float,
    pinhole: tuple[float, float, float, float],
    boxes: Floats,
    box: int,
    least: float,
    holes: Field,
    size: tuple[int, int, int],
    codes: Codes,
) -> None:
    """Makes holes in what lies in a box.

    Args:
        disparity: (H * S,) true ones; S = W + 2 * margin.
        disparity_m: disparity = this / depth.
        pinhole: fx, fy, cx, cy.
        boxes: (K, 4, 3) in camera axes: centres, and axes over half extents.
        box: which of them.
        least: number of the holes' field from which on a pixel is seen.
        holes: random field.
        size: W, H, margin.
        codes: (H * S,) written.
    """
    fx, fy, cx, cy = pinhole
    width, height, margin = size
    center = triple(boxes, box, 0)
    limit, stride = np.int16(least), width + 2 * margin
    first_column, end_column = _span(boxes, box, 0, fx, cx, width)
    first_row, end_row = _span(boxes, box, 1, fy, cy, height)
    a, b, c = triple(boxes, box, 1), triple(boxes, box, 2), triple(boxes, box, 3)
    # Along an axis a point is at (slope * column + start) * z - middle, in half extents.
    slopes = (_float(a[0] / fx), _float(b[0] / fx), _float(c[0] / fx))
    middles = (
        _float(dot(a, center) / disparity_m),
        _float(dot(b, center) / disparity_m),
        _float(dot(c, center) / disparity_m),
    )
    for row in range(first_row, end_row):
        ray = ((first_column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0)
        starts = (_float(dot(a, ray)), _float(dot(b, ray)), _float(dot(c, ray)))
        begin = row * stride + margin + first_column
        _darken_row(
            disparity,
            holes,
            begin,
            end_column - first_column,
            slopes,
            starts,
            middles,
            _float(1.0 / disparity_m),
            limit,
            codes,
        )


@kernel(counts=False)
def _float(number: float) -> np.float32:
    return np.float32(number)


@kernel(counts=False)
def _span(boxes: Floats, box: int, side: int, focal: float, middle: float, pixels: int) -> Span:
    """The first column (`side` 0) or row (1) that a box can be in, and that behind the last."""
    low, high = float(pixels), 0.0
    for corner in range(8):
        depth, offset = boxes[box, 0, 2], boxes[box, 0, side]
        for axis in range(3):
            x, y, z = triple(boxes, box, 1 + axis)
            # An axis over its half extent, over its square, is the half extent along the axis.
            sign = 1.0 if corner >> axis & 1 else -1.0
            scale = sign / (x * x + y * y + z * z)
            depth += scale * z
            offset += scale * (x if side == 0 else y)
        if depth < MIN_DEPTH_M:
            return 0, pixels
        place = focal * offset / depth + middle
        low, high = min(low, place), max(high, place)
    return int(max(math.floor(low), 0.0)), int(min(math.ceil(high), float(pixels)))


@kernel(counts=False, fastmath=FAST)
def _darken_row(
    disparity: Pixels,
    holes: Field,
    begin: int,
    count: int,
    slopes: tuple[np.float32, np.float32, np.float32],
    starts: tuple[np.float32, np.float32, np.float32],
    middles: tuple[np.float32, np.float32, np.float32],
    per_disparity_m: np.float32,
    limit: np.int16,
    codes: Codes,
) -> None:
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = slopes, starts, middles
    first = np.uint32(begin)
    for i in range(np.uint32(count)):
        column, d, hole = np.float32(np.int32(i)), disparity[first + i], holes[first + i]
        # Times the inverse depth, so that nothing is divided.
        x, y = abs(ax * column + bx - cx * d), abs(ay * column + by - cy * d)
        z, inverse = abs(az * column + bz - cz * d), per_disparity_m * d
        is_missing = (x <= inverse) & (y <= inverse) & (z <= inverse) & (hole < limit)
        codes[first + i] = np.uint16(NOTHING_SEEN) if is_missing else codes[first + i]
