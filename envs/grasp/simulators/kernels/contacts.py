"""Contacts of the robot's boxes and cylinders with the boxes of its world along a motion.

Conservative advancement: a shape that is a distance away from everything, and none of whose points
moves faster than a bound, touches nothing for the time that is their quotient, and is looked at
again after it. Where shapes are nearer than the resolution, that is taken for the distance.
Mirtich, "Impulse-based dynamic simulation of rigid body systems", 1996, section 2.3.

A point p that joints move is known to within its acceleration: with
joint k further out than joint j or the same, d2p/dq_j dq_k = a_j x (a_k x (p - o_k)), which is no
longer than the point's distance from joint k. So in a time t no point of a shape moves further than
v t + A t^2 / 2, where v is the largest speed of a point of its ball now and
A = sum_k |q'_k| L_k (|q'_k| + 2 sum_{j<k} |q'_j|) + sum_k |q''_k| L_k, L_k its reach from joint k.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from envs.grasp.simulators.kernels.pairs import (
    Pair,
    gap_between,
    make_pair,
    meets,
)
from envs.grasp.simulators.kernels.worlds import (
    Bools,
    Floats,
    Integers,
    RobotArrays,
    Vector,
    WorldArrays,
    column_in_world,
    cross,
    dot,
    in_world,
    kernel,
    minus,
    move_links,
    triple,
)


class Room(NamedTuple):
    """Room to work in, for one thread.

    Attributes:
        leg: (3, J) a leg's joint angles at its start, their first and their second derivatives.
        pose: (1, 1, J) joint angles now.
        speeds: (J,) first derivatives now.
        frames: (L, 3, 4) of the links.
        turns, drifts: (L, 3) angular velocities of the links, and velocities of their origins.
        rates: (L,) sizes of the angular velocities.
        bends: (S,) largest accelerations of the shapes' points on the leg.
        idle: (S,) whether nothing more can happen to the shapes on the leg.
    """

    leg: Floats
    pose: Floats
    speeds: Floats
    frames: Floats
    turns: Floats
    drifts: Floats
    rates: Floats
    bends: Floats
    idle: Bools


@kernel(nogil=True)
def touch_along(
    robot: RobotArrays,
    worlds: WorldArrays,
    indices: Integers,
    paths: Floats,
    resolution: float,
    touched: Bools,
    collided: Bools,
    begin: int,
    end: int,
) -> None:
    """Tells what robots touch along paths; where they stand is left as it is.

    Args:
        robot: the robot.
        worlds: where the boxes are.
        indices: (n,) the worlds.
        paths: (n, 2 k + 1, J) knots in radians, see `envs.grasp.robot.paths`.
        resolution: in metres, see `envs.grasp.simulators.base.Simulator.move`.
        touched: (n,) written, see `envs.grasp.simulators.base.Contacts`.
        collided: (n,) written.
        begin: first row that is meant.
        end: row before which to end.
    """
    joints, links, shapes = len(robot.axes), len(robot.parents), len(robot.shape_links)
    room, pair = (
        Room(
            np.empty((3, joints)),
            np.empty((1, 1, joints)),
            np.empty(joints),
            np.empty((links, 3, 4)),
            np.zeros((links, 3)),
            np.zeros((links, 3)),
            np.zeros(links),
            np.empty(shapes),
            np.empty(shapes, np.bool_),
        ),
        make_pair(),
    )
    for row in range(begin, end):
        touched[row], collided[row] = _contacts(
            robot, worlds, indices[row], paths, row, resolution, room, pair
        )


@kernel(counts=False)
def _contacts(
    robot: RobotArrays,
    worlds: WorldArrays,
    world: int,
    paths: Floats,
    row: int,
    resolution: float,
    room: Room,
    pair: Pair,
) -> tuple[bool, bool]:
    """Whether one motion touches, and whether it collides."""
    touched = collided = False
    legs = _legs_that_count(paths, row)
    for leg in range(legs):
        if not _begin_leg(paths, row, leg, robot.shape_reach, room):
            continue
        part = 0.0
        # Where a leg ends the next one begins, and is looked at then.
        while part < 1.0:
            touched, collided, part = _look(
                robot, worlds, world, part, resolution, touched, collided, room, pair
            )
            if touched and collided:
                return True, True
    if legs == 0:
        _begin_pose(paths, row, room)
    touched, collided, _ = _look(
        robot, worlds, world, 1.0, resolution, touched, collided, room, pair
    )
    return touched, collided


@kernel(counts=False)
def _legs_that_count(paths: Floats, row: int) -> int:
    """Number of legs to the end of the last one that moves."""
    for knot in range(paths.shape[1] - 1, 0, -1):
        for joint in range(paths.shape[2]):
            if paths[row, knot, joint] != paths[row, knot - 1, joint]:
                return (knot + 1) // 2
    return 0


@kernel(counts=False)
def _begin_pose(paths: Floats, row: int, room: Room) -> None:
    """Takes the last knot for a leg on which nothing moves."""
    room.leg[:], room.bends[:], room.idle[:] = 0.0, 0.0, False
    for joint in range(paths.shape[2]):
        room.leg[0, joint] = paths[row, -1, joint]


@kernel(counts=False)
def _begin_leg(paths: Floats, row: int, number: int, reach: Floats, room: Room) -> bool:
    """Writes a leg as q = leg[0] + leg[1] t + leg[2] t^2 / 2, and the shapes' accelerations.

    Returns whether anything moves on it.
    """
    leg, first, moves, before = room.leg, 2 * number, False, 0.0
    room.idle[:], room.bends[:] = False, 0.0
    for joint in range(paths.shape[2]):
        start, middle, end = (
            paths[row, first, joint],
            paths[row, first + 1, joint],
            paths[row, first + 2, joint],
        )
        leg[0, joint] = start
        leg[1, joint] = 4.0 * middle - 3.0 * start - end
        leg[2, joint] = 4.0 * (start + end - 2.0 * middle)
        moves = moves or middle != start or end != start
        # The speed is linear in time, and largest at an end.
        speed = max(abs(leg[1, joint]), abs(leg[1, joint] + leg[2, joint]))
        turns = speed * (speed + 2.0 * before) + abs(leg[2, joint])
        before += speed
        for shape in range(len(reach)):
            room.bends[shape] += reach[shape, joint] * turns
    return moves


@kernel(counts=False)
def _look(
    robot: RobotArrays,
    worlds: WorldArrays,
    world: int,
    part: float,
    resolution: float,
    touched: bool,
    collided: bool,
    room: Room,
    pair: Pair,
) -> tuple[bool, bool, float]:
    """Looks at a part of a leg.

    Returns what was touched so far, and the part at which to look next.
    """
    links, poses, radii, idle = robot.shape_links, robot.shape_poses, robot.shape_radius, room.idle
    frames, left = room.frames, 1.0 - part
    step = left
    if idle.all():
        return touched, collided, 1.0
    _stand(robot, part, room)
    # The tool comes first: it is the nearest mostly, and then others need not be told apart.
    for shape in range(len(links) - 1, -1, -1):
        if idle[shape]:
            continue
        radius, link, bend = radii[shape], links[shape], room.bends[shape]
        center = in_world(frames, link, poses[shape, 0, 3], poses[shape, 1, 3], poses[shape, 2, 3])
        speed = _largest_speed(frames, room.turns, room.drifts, room.rates, link, center, radius)
        clear = math.sqrt(_square_beyond_all(worlds.low, worlds.high, world, center)) - radius
        done = collided and (touched or not robot.is_cup[shape])
        idle[shape] = done or clear > left * (speed + left * bend / 2.0)
        far = step * (speed + step * bend / 2.0)
        if idle[shape] or clear > far:
            continue
        clear, touched, collided = _nearest(
            robot, worlds, world, shape, center, far, touched, collided, frames, pair
        )
        if clear < far:
            # v t + A t^2 / 2 = distance
            distance = max(clear, resolution)
            root = math.sqrt(speed * speed + 2.0 * bend * distance)
            step = min(step, 2.0 * distance / (speed + root))
    return touched, collided, part + step if step < left else 1.0


@kernel(counts=False)
def _nearest(
    robot: RobotArrays,
    worlds: WorldArrays,
    world: int,
    shape: int,
    center: Vector,
    far: float,
    touched: bool,
    collided: bool,
    frames: Floats,
    pair: Pair,
) -> tuple[float, bool, bool]:
    """The distance of a shape to what it does not touch yet, `far` at most, and what it touches.

    Boxes that would change nothing any more are left out.
    """
    radius, link, half = robot.shape_radius[shape], robot.shape_links[shape], robot.shape_half
    is_cylinder, is_cup = robot.is_cylinder[shape], robot.is_cup[shape]
    axes, sizes, clear = worlds.axes, worlds.half, far
    for part in range(worlds.low.shape[1]):
        within = radius + clear
        if _square_beyond(worlds.low, worlds.high, world, part, center) > within * within:
            continue
        for box in range(worlds.starts[world, part], worlds.starts[world, part + 1]):
            touch = is_cup and worlds.is_target[world, box]
            reach = worlds.radius[world, box]
            if reach == 0.0 or (touched if touch else collided):
                continue
            offset = minus(center, triple(worlds.center, world, box))
            within = radius + clear
            if dot(offset, offset) > (reach + within) * (reach + within):
                continue
            square = _see(offset, axes, sizes, world, box, pair.offset)
            if square > within * within:
                continue
            apart = math.sqrt(square) - radius
            if apart > radius:
                clear = apart
                continue
            _turn(frames, link, robot.shape_poses, shape, axes, world, box, pair.turn)
            gap = max(gap_between(is_cylinder, half[shape], sizes[world, box], pair), apart)
            if gap <= 0.0 and meets(is_cylinder, half[shape], sizes[world, box], pair):
                touched, collided = touched or touch, collided or not touch
            else:
                clear = min(clear, max(gap, 0.0))
    return clear, touched, collided


@kernel(counts=False)
def _turn(
    frames: Floats,
    link: int,
    poses: Floats,
    shape: int,
    axes: Floats,
    world: int,
    box: int,
    turn: Floats,
) -> None:
    """Writes the axes of a link's shape (3, 3), as columns, in a box's frame."""
    for j in range(3):
        direction = column_in_world(frames, link, poses, shape, j)
        for i in range(3):
            axis = (axes[world, box, 0, i], axes[world, box, 1, i], axes[world, box, 2, i])
            turn[i, j] = dot(axis, direction)


@kernel(counts=False)
def _stand(robot: RobotArrays, part: float, room: Room) -> None:
    """Moves the links to where they are at a part of the leg, and finds their velocities."""
    leg, frames, turns, drifts = room.leg, room.frames, room.turns, room.drifts
    for joint in range(len(room.speeds)):
        room.speeds[joint] = leg[1, joint] + part * leg[2, joint]
        room.pose[0, 0, joint] = leg[0, joint] + part * (leg[1, joint] + part * leg[2, joint] / 2.0)
    move_links(robot.parents, robot.joints, robot.origins, robot.axes, room.pose, 0, 0, frames)
    for link in range(len(robot.parents)):
        parent, joint = robot.parents[link], robot.joints[link]
        if parent < 0:
            continue
        turn = (turns[parent, 0], turns[parent, 1], turns[parent, 2])
        offset = (
            frames[link, 0, 3] - frames[parent, 0, 3],
            frames[link, 1, 3] - frames[parent, 1, 3],
            frames[link, 2, 3] - frames[parent, 2, 3],
        )
        sweep = cross(turn, offset)
        for i in range(3):
            drifts[link, i] = drifts[parent, i] + sweep[i]
            turns[link, i] = turn[i]
            if joint >= 0:
                for k in range(3):
                    axis = frames[link, i, k] * robot.axes[joint, k]
                    turns[link, i] += axis * room.speeds[joint]
        room.rates[link] = math.sqrt(
            turns[link, 0] * turns[link, 0]
            + turns[link, 1] * turns[link, 1]
            + turns[link, 2] * turns[link, 2]
        )


@kernel(counts=False)
def _largest_speed(
    frames: Floats,
    turns: Floats,
    drifts: Floats,
    rates: Floats,
    link: int,
    center: Vector,
    radius: float,
) -> float:
    """The largest speed of a point of a ball that moves with a link."""
    turn = (turns[link, 0], turns[link, 1], turns[link, 2])
    offset = (
        center[0] - frames[link, 0, 3],
        center[1] - frames[link, 1, 3],
        center[2] - frames[link, 2, 3],
    )
    sweep = cross(turn, offset)
    velocity = (
        drifts[link, 0] + sweep[0],
        drifts[link, 1] + sweep[1],
        drifts[link, 2] + sweep[2],
    )
    return math.sqrt(dot(velocity, velocity)) + radius * rates[link]


@kernel(counts=False)
def _square_beyond(low: Floats, high: Floats, world: int, part: int, point: Vector) -> float:
    """The squared distance of a point to one of the rooms; infinite if that is empty."""
    square = 0.0
    for i in range(3):
        beyond = max(0.0, low[world, part, i] - point[i], point[i] - high[world, part, i])
        square += beyond * beyond
    return square


@kernel(counts=False)
def _square_beyond_all(low: Floats, high: Floats, world: int, point: Vector) -> float:
    """The squared distance of a point to the nearest of the rooms."""
    square = math.inf
    for part in range(low.shape[1]):
        square = min(square, _square_beyond(low, high, world, part, point))
    return square


@kernel(counts=False)
def _see(offset: Vector, axes: Floats, sizes: Floats, world: int, box: int, local: Floats) -> float:
    """Writes an offset (3,) from a box in the box's frame; returns its squared distance."""
    square = 0.0
    for k in range(3):
        axis = (axes[world, box, 0, k], axes[world, box, 1, k], axes[world, box, 2, k])
        local[k] = dot(axis, offset)
        beyond = max(0.0, abs(local[k]) - sizes[world, box, k])
        square += beyond * beyond
    return square
