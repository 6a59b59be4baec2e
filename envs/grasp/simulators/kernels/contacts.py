"""Whether the robot's boxes and cylinders touch the boxes of its world.

Balls about the shapes tell most pairs apart; the others are tested exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from envs.grasp.simulators.kernels.worlds import (
    Bools,
    Floats,
    Integers,
    RobotArrays,
    Vector,
    WorldArrays,
    column_in_world,
    dot,
    in_world,
    kernel,
    minus,
    move_links,
    triple,
)

# Added to the products of edges: of parallel ones nothing would be left but rounding errors.
PARALLEL_EDGES = 1e-9
CONVERGED_M2 = 1e-14
MAX_ITERATIONS = 64
BOX_EDGES = 12


class Room(NamedTuple):
    """Room to work in, for one thread.

    Attributes:
        frames: (L, 3, 4) of the links.
        offset: (3,) from a box to a shape, in the box's frame.
        turn, size: (3, 3) a shape's axes in a box's frame, and their absolute values.
        points: (24, 2) projected to a cylinder's end.
    """

    frames: Floats
    offset: Floats
    turn: Floats
    size: Floats
    points: Floats


@kernel(nogil=True)
def touch_along(
    robot: RobotArrays,
    worlds: WorldArrays,
    indices: Integers,
    paths: Floats,
    touched: Bools,
    collided: Bools,
    begin: int,
    end: int,
) -> None:
    """Tells what robots touch along joint poses; where they stand is left as it is.

    Args:
        robot: the robot.
        worlds: where the boxes are.
        indices: (n,) the worlds.
        paths: (n, p, J) joint angles in radians.
        touched: (n,) written, see `envs.grasp.simulators.base.Contacts`.
        collided: (n,) written.
        begin: first row that is meant.
        end: row before which to end.
    """
    room = Room(
        np.empty((len(robot.parents), 3, 4)),
        np.empty(3),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((2 * BOX_EDGES, 2)),
    )
    for row in range(begin, end):
        touched[row], collided[row] = _contacts(robot, worlds, indices[row], paths, row, room)


@kernel()
def _contacts(
    robot: RobotArrays, worlds: WorldArrays, world: int, paths: Floats, row: int, room: Room
) -> tuple[bool, bool]:
    """Whether one motion touches, and whether it collides."""
    touched = collided = False
    links, poses, half, radii = (
        robot.shape_links,
        robot.shape_poses,
        robot.shape_half,
        robot.shape_radius,
    )
    frames, middles, axes = room.frames, worlds.center, worlds.axes
    sizes, reaches, is_target = worlds.half, worlds.radius, worlds.is_target
    for pose in range(paths.shape[1]):
        move_links(robot.parents, robot.joints, robot.origins, robot.axes, paths, row, pose, frames)
        for shape in range(len(links)):
            is_cup, radius, link = robot.is_cup[shape], radii[shape], links[shape]
            if collided and (touched or not is_cup):
                continue
            center = in_world(
                frames, link, poses[shape, 0, 3], poses[shape, 1, 3], poses[shape, 2, 3]
            )
            if _leaves_room(worlds.low, worlds.high, world, center, radius):
                continue
            for box in range(sizes.shape[1]):
                touch = is_cup and is_target[world, box]
                if reaches[world, box] == 0.0 or (touched if touch else collided):
                    continue
                offset = minus(center, triple(middles, world, box))
                if _is_apart(offset, radius, axes, sizes, reaches, world, box):
                    continue
                for i in range(3):
                    axis = (axes[world, box, 0, i], axes[world, box, 1, i], axes[world, box, 2, i])
                    room.offset[i] = dot(axis, offset)
                    for j in range(3):
                        room.turn[i, j] = dot(axis, column_in_world(frames, link, poses, shape, j))
                if robot.is_cylinder[shape]:
                    meet = cylinder_meets_box(half[shape], sizes[world, box], room)
                else:
                    meet = boxes_meet(half[shape], sizes[world, box], room)
                touched, collided = touched or (meet and touch), collided or (meet and not touch)
    return touched, collided


@kernel()
def _leaves_room(low: Floats, high: Floats, world: int, center: Vector, radius: float) -> bool:
    """Whether a ball stays away from all boxes, by the room they take along the world's axes."""
    return (
        center[0] + radius < low[world, 0]
        or center[0] - radius > high[world, 0]
        or center[1] + radius < low[world, 1]
        or center[1] - radius > high[world, 1]
        or center[2] + radius < low[world, 2]
        or center[2] - radius > high[world, 2]
    )


@kernel()
def _is_apart(
    offset: Vector,
    radius: float,
    axes: Floats,
    sizes: Floats,
    reaches: Floats,
    world: int,
    box: int,
) -> bool:
    """Whether a ball meets neither the ball about a box nor the box, at `offset` from it."""
    reach = radius + reaches[world, box]
    if dot(offset, offset) > reach * reach:
        return True
    apart = 0.0
    for k in range(3):
        axis = (axes[world, box, 0, k], axes[world, box, 1, k], axes[world, box, 2, k])
        beyond = max(0.0, abs(dot(axis, offset)) - sizes[world, box, k])
        apart += beyond * beyond
    return apart > radius * radius


@kernel()
def boxes_meet(half: Floats, box_half: Floats, room: Room) -> bool:
    """Whether two boxes have a point in common, by their 15 possible separating axes.

    Source: Gottschalk, Lin and Manocha, "OBBTree", SIGGRAPH 1996.
    """
    turn, size, offset = room.turn, room.size, room.offset
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


@kernel()
def cylinder_meets_box(half: Floats, box_half: Floats, room: Room) -> bool:
    """Whether a cylinder and a box have a point in common.

    What of the box lies between the cylinder's ends is a polytope whose corners lie on the box's
    edges. Seen along the cylinder's axis it is the hull of those corners, which meets the cylinder
    where it comes within the radius of the axis.
    """
    radius, half_length, count = half[0], half[2], 0
    for edge in range(BOX_EDGES):
        first = _edge_end(edge, -1.0, box_half, room)
        second = _edge_end(edge, 1.0, box_half, room)
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
            room.points[count, 0] = first[0] + part * (second[0] - first[0])
            room.points[count, 1] = first[1] + part * (second[1] - first[1])
            count += 1
    return count > 0 and _hull_comes_within(radius, room.points, count)


@kernel()
def _edge_end(edge: int, side: float, box_half: Floats, room: Room) -> tuple[float, float, float]:
    """An end of one of the 12 edges of the box, in the cylinder's frame."""
    k = edge // 4
    i, j = (k + 1) % 3, (k + 2) % 3
    along = side * box_half[k] - room.offset[k]
    across = (box_half[i] if edge & 1 else -box_half[i]) - room.offset[i]
    up = (box_half[j] if edge & 2 else -box_half[j]) - room.offset[j]
    turn = room.turn
    return (
        turn[k, 0] * along + turn[i, 0] * across + turn[j, 0] * up,
        turn[k, 1] * along + turn[i, 1] * across + turn[j, 1] * up,
        turn[k, 2] * along + turn[i, 2] * across + turn[j, 2] * up,
    )


@kernel()
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


@kernel()
def _nearest_on_segment(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    """The point nearest to the origin between two points."""
    x, y = b[0] - a[0], b[1] - a[1]
    square = x * x + y * y
    part = 0.0 if square == 0.0 else min(1.0, max(0.0, -(a[0] * x + a[1] * y) / square))
    return a[0] + part * x, a[1] + part * y


@kernel()
def _triangle_holds_origin(
    a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]
) -> bool:
    """Whether the origin lies inside a triangle of any orientation."""
    ab = a[0] * b[1] - a[1] * b[0]
    bc = b[0] * c[1] - b[1] * c[0]
    ca = c[0] * a[1] - c[1] * a[0]
    return (ab > 0.0 and bc > 0.0 and ca > 0.0) or (ab < 0.0 and bc < 0.0 and ca < 0.0)
