"""A box or cylinder of the robot and a box of its world: whether they meet, and how far apart.

The tests are exact; the gaps are lower bounds of the distance, by separating axes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from envs.grasp.simulators.kernels.worlds import Floats, kernel

# Added to the products of edges: of parallel ones nothing would be left but rounding errors.
PARALLEL_EDGES = 1e-9
CONVERGED_M2 = 1e-14
MAX_ITERATIONS = 64
BOX_EDGES = 12


class Pair(NamedTuple):
    """A shape as a box sees it, and room to work in, for one thread.

    Attributes:
        offset: (3,) from the box to the shape, in the box's frame.
        turn, size: (3, 3) the shape's axes in the box's frame, and their absolute values.
        points: (24, 2) projected to a cylinder's end.
    """

    offset: Floats
    turn: Floats
    size: Floats
    points: Floats


@kernel()
def make_pair() -> Pair:
    """Room for a pair."""
    return Pair(np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((2 * BOX_EDGES, 2)))


@kernel(counts=False)
def gap_between(is_cylinder: bool, half: Floats, box_half: Floats, pair: Pair) -> float:
    """A lower bound of the distance of a box or cylinder from a box; not over 0 where they meet."""
    if is_cylinder:
        return cylinder_gap(pair.offset, pair.turn, half, box_half)
    return box_gap(pair.offset, pair.turn, half, box_half)


@kernel(counts=False)
def meets(is_cylinder: bool, half: Floats, box_half: Floats, pair: Pair) -> bool:
    """Whether a box or cylinder and a box have a point in common."""
    if is_cylinder:
        return cylinder_meets_box(half, box_half, pair)
    return boxes_meet(half, box_half, pair)


@kernel(counts=False)
def box_gap(offset: Floats, turn: Floats, half: Floats, box_half: Floats) -> float:
    """The widest gap between two boxes along an axis of either, negative where all overlap."""
    gap = -math.inf
    for i in range(3):
        reach = box_half[i]
        for j in range(3):
            reach += half[j] * abs(turn[i, j])
        gap = max(gap, abs(offset[i]) - reach)
    for j in range(3):
        reach, along = half[j], 0.0
        for i in range(3):
            reach += box_half[i] * abs(turn[i, j])
            along += offset[i] * turn[i, j]
        gap = max(gap, abs(along) - reach)
    return gap


@kernel(counts=False)
def cylinder_gap(offset: Floats, turn: Floats, half: Floats, box_half: Floats) -> float:
    """The widest gap between a cylinder and a box along the box's axes and the cylinder's."""
    gap, reach, along = -math.inf, half[2], 0.0
    for i in range(3):
        # Along a direction at an angle a to its axis, a cylinder reaches h |cos a| + r sin a.
        cosine = turn[i, 2]
        cylinder = half[2] * abs(cosine) + half[0] * math.sqrt(max(0.0, 1.0 - cosine * cosine))
        gap = max(gap, abs(offset[i]) - box_half[i] - cylinder)
        reach += box_half[i] * abs(cosine)
        along += offset[i] * cosine
    return max(gap, abs(along) - reach)


@kernel(counts=False)
def boxes_meet(half: Floats, box_half: Floats, pair: Pair) -> bool:
    """Whether two boxes have a point in common, by their 15 possible separating axes.

    Source: Gottschalk, Lin and Manocha, "OBBTree", SIGGRAPH 1996.
    """
    turn, size, offset = pair.turn, pair.size, pair.offset
    for i in range(3):
        reach = box_half[i]
        for j in range(3):
            size[i, j] = abs(turn[i, j]) + PARALLEL_EDGES
            reach += half[j] * abs(turn[i, j])
        if abs(offset[i]) > reach:
            return False
    for j in range(3):
        reach, along = half[j], 0.0
        for i in range(3):
            reach += box_half[i] * abs(turn[i, j])
            along += offset[i] * turn[i, j]
        if abs(along) > reach:
            return False
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            reach = (
                box_half[i1] * size[i2, j]
                + box_half[i2] * size[i1, j]
                + half[j1] * size[i, j2]
                + half[j2] * size[i, j1]
            )
            if abs(offset[i2] * turn[i1, j] - offset[i1] * turn[i2, j]) > reach:
                return False
    return True


@kernel(counts=False)
def cylinder_meets_box(half: Floats, box_half: Floats, pair: Pair) -> bool:
    """Whether a cylinder and a box have a point in common.

    What of the box lies between the cylinder's ends is a polytope whose corners lie on the box's
    edges. Seen along the cylinder's axis it is the hull of those corners, which meets the cylinder
    where it comes within the radius of the axis.
    """
    radius, half_length, count = half[0], half[2], 0
    for edge in range(BOX_EDGES):
        first = _edge_end(edge, -1.0, box_half, pair)
        second = _edge_end(edge, 1.0, box_half, pair)
        begin, end, rise = 0.0, 1.0, second[2] - first[2]
        if rise < 0.0:
            first, second, rise = second, first, -rise
        if first[2] > half_length or second[2] < -half_length:
            continue
        if first[2] < -half_length:
            begin = (-half_length - first[2]) / rise
        if second[2] > half_length:
            end = (half_length - first[2]) / rise
        for part in (begin, end):
            pair.points[count, 0] = first[0] + part * (second[0] - first[0])
            pair.points[count, 1] = first[1] + part * (second[1] - first[1])
            count += 1
    return count > 0 and _hull_comes_within(radius, pair.points, count)


@kernel(counts=False)
def _edge_end(edge: int, side: float, box_half: Floats, pair: Pair) -> tuple[float, float, float]:
    """An end of one of the 12 edges of the box, in the cylinder's frame."""
    k = edge // 4
    i, j = (k + 1) % 3, (k + 2) % 3
    along = side * box_half[k] - pair.offset[k]
    across = (box_half[i] if edge & 1 else -box_half[i]) - pair.offset[i]
    up = (box_half[j] if edge & 2 else -box_half[j]) - pair.offset[j]
    turn = pair.turn
    return (
        turn[k, 0] * along + turn[i, 0] * across + turn[j, 0] * up,
        turn[k, 1] * along + turn[i, 1] * across + turn[j, 1] * up,
        turn[k, 2] * along + turn[i, 2] * across + turn[j, 2] * up,
    )


@kernel(counts=False)
def _hull_comes_within(radius: float, points: Floats, count: int) -> bool:
    """Whether the convex hull of points (count, 2) comes within `radius` of the origin.

    Gilbert, Johnson and Keerthi, "A fast procedure for computing the distance between complex
    objects in three-dimensional space", 1988, in two dimensions.
    """
    a = b = v = (points[0, 0], points[0, 1])
    for _ in range(MAX_ITERATIONS):
        square = v[0] * v[0] + v[1] * v[1]
        if square <= radius * radius:
            return True
        s, least = v, square
        for i in range(count):
            product = v[0] * points[i, 0] + v[1] * points[i, 1]
            if product < least:
                s, least = (points[i, 0], points[i, 1]), product
        # No point of the hull is nearer than its foremost plane, nor farther than v.
        if least > radius * np.sqrt(square) or square - least <= CONVERGED_M2:
            return False
        if _triangle_holds_origin(a, b, s):
            return True
        with_a, with_b = _nearest_on_segment(a, s), _nearest_on_segment(b, s)
        if with_a[0] ** 2 + with_a[1] ** 2 <= with_b[0] ** 2 + with_b[1] ** 2:
            b, v = s, with_a
        else:
            a, v = s, with_b
    return False


@kernel(counts=False)
def _nearest_on_segment(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    """The point nearest to the origin between two points."""
    x, y = b[0] - a[0], b[1] - a[1]
    square = x * x + y * y
    part = 0.0 if square == 0.0 else min(1.0, max(0.0, -(a[0] * x + a[1] * y) / square))
    return a[0] + part * x, a[1] + part * y


@kernel(counts=False)
def _triangle_holds_origin(
    a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]
) -> bool:
    """Whether the origin lies inside a triangle of any orientation."""
    ab = a[0] * b[1] - a[1] * b[0]
    bc = b[0] * c[1] - b[1] * c[0]
    ca = c[0] * a[1] - c[1] * a[0]
    return (ab > 0.0 and bc > 0.0 and ca > 0.0) or (ab < 0.0 and bc < 0.0 and ca < 0.0)
