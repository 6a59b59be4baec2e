"""What a camera sees and the projector beside it does not: shadows beside near things.

A point of column u and disparity d is in the projector's column u - d, or u + d where the projector
is on the left. So a point u' on the projector's side hides it if d' - d > |u' - u|.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.grasp.sensors.noise import FAST
from envs.grasp.simulators.kernels.worlds import kernel

Pixels = NDArray[np.float32]

# Less than any disparity less the way to it.
HIDES_NOTHING = np.float32(-1e9)
# So many columns, equally far apart, are looked at in one pass over the picture.
TAPS = 4


def reach(width: int) -> int:
    """How far, at least the width, some passes look: a power of `TAPS`, more than one pass does."""
    columns = TAPS * TAPS
    while columns < width:
        columns *= TAPS
    return columns


@kernel(counts=False, fastmath=FAST)
def greatest(numbers: Pixels, begin: int, count: int) -> float:
    """The greatest of some numbers, of which none is less than 0."""
    first, most = np.uint32(begin), np.int32(0)
    for i in range(np.uint32(count)):
        # It has the greatest bits, too, and whole numbers are compared in vectors.
        bits = np.float32(numbers[first + i]).view(np.int32)
        most = bits if bits > most else most
    return float(np.int32(most).view(np.float32))


@kernel(counts=False, fastmath=FAST)
def place(
    true: Pixels,
    first_row: int,
    disparity_m: float,
    width: int,
    margin: int,
    lower: float,
    disparity: Pixels,
    keys: Pixels,
) -> None:
    """Puts disparities into rows with margins, and a row above and below: all repeat what is next.

    Args:
        true: inverse depths, 1/m, W to a row.
        first_row: of those that are meant.
        disparity_m: disparity = this * inverse depth.
        width: W.
        margin: columns beside the picture, on either side.
        lower: by how much the keys of each row are lower than those of the last: with more than
            the greatest disparity, a row hides nothing of the row before it.
        disparity: ((H + 2) * S,) written; S = W + 2 * margin.
        keys: (more than H * S,) the same, in the middle, without the rows above and below.
    """
    scale, stride = np.float32(disparity_m), width + 2 * margin
    height = len(disparity) // stride - 2
    start = (len(keys) - height * stride) // 2
    for row in range(height):
        source, low = np.uint32((first_row + row) * width), np.float32(lower * row)
        here, key = (row + 1) * stride + margin, start + row * stride + margin
        to, to_key = np.uint32(here), np.uint32(key)
        for column in range(np.uint32(width)):
            value = scale * true[source + column]
            disparity[to + column], keys[to_key + column] = value, value - low
        for column in range(1, margin + 1):
            before, behind = disparity[here], disparity[here + width - 1]
            disparity[here - column], disparity[here + width - 1 + column] = before, behind
            keys[key - column], keys[key + width - 1 + column] = before - low, behind - low
    for column in range(stride):
        disparity[column] = disparity[stride + column]
        disparity[(height + 1) * stride + column] = disparity[height * stride + column]


@kernel(counts=False, fastmath=FAST)
def rows_with(true: Pixels, width: int, height: int, least: float) -> tuple[int, int]:
    """The first of the rows that hold a number of at least this, and the one behind the last."""
    first, end, limit = 0, height, np.float32(least)
    while first < end and not _holds(true, first * width, width, limit):
        first += 1
    while first < end and not _holds(true, (end - 1) * width, width, limit):
        end -= 1
    return first, end


@kernel(counts=False, fastmath=FAST)
def _holds(true: Pixels, begin: int, count: int, limit: np.float32) -> bool:
    start, found = np.uint32(begin), np.int32(0)
    for i in range(np.uint32(count)):
        found |= np.int32(true[start + i] >= limit)
    return bool(found > 0)


@kernel()
def find_shadows(
    size: int,
    factor: float,
    longest: float,
    keys: Pixels,
    hidden: Pixels,
    other: Pixels,
) -> Pixels:
    """The greatest keys that are in the shadow of something else, two columns or more away.

    The edge of what hides lies half a column before its first pixel, on average. What the very next
    pixel hides is told from its slope.

    Args:
        size: P pixels in all rows.
        factor: on the disparity; less than 0: the projector is on the left; 0: no shadows.
        longest: shadow that matters, in columns.
        keys: (P + 2 R,) of the pixels, see `place`, after and before R = `reach` others.
        hidden: room for as many.
        other: room for as many.

    Returns:
        One of the two. A pixel is in the shadow if its key is under what this holds.
    """
    margin, side = (len(keys) - size) // 2, 1 if factor >= 0.0 else -1
    if not longest > 0.0:
        _hide_nothing(hidden, 0, len(hidden))
        return hidden
    for array in (keys, hidden, other):
        _hide_nothing(array, 0, margin)
        _hide_nothing(array, margin + size, margin)
    way, step = np.float32(1.0 / abs(factor)), TAPS
    _take_greatest(keys, margin, size, 2 * side, side, np.float32(1.5) * way, way, hidden)
    while step < longest and step < margin:
        hidden, other = other, hidden
        _take_greatest(
            other,
            margin,
            size,
            0,
            side * step,
            np.float32(0.0),
            np.float32(step) * way,
            hidden,
        )
        step *= TAPS
    return hidden


@kernel(counts=False)
def _hide_nothing(keys: Pixels, begin: int, count: int) -> None:
    first = np.uint32(begin)
    for i in range(np.uint32(count)):
        keys[first + i] = HIDES_NOTHING


@kernel(counts=False, fastmath=FAST)
def _take_greatest(
    source: Pixels,
    margin: int,
    size: int,
    first: int,
    step: int,
    first_way: np.float32,
    way: np.float32,
    target: Pixels,
) -> None:
    """The greatest of `TAPS` pixels, from the first on a step apart, each less the way to it."""
    begin, nearest = np.uint32(margin), np.uint32(margin + first)
    near, far = np.uint32(margin + first + step), np.uint32(margin + first + 2 * step)
    farthest = np.uint32(margin + first + 3 * step)
    near_way, far_way = first_way + way, first_way + np.float32(2.0) * way
    farthest_way = first_way + np.float32(3.0) * way
    for i in range(np.uint32(size)):
        a, b = source[nearest + i] - first_way, source[near + i] - near_way
        c, d = source[far + i] - far_way, source[farthest + i] - farthest_way
        one, two = a if a > b else b, c if c > d else d
        target[begin + i] = one if one > two else two
