"""What stands around the blocks and is none of them: drawn scene by scene, all of it boxes.

Nothing here stands where a block does, nor in the way of the tool to the target, and nothing hides
the target's grasp disc from a camera. A thing that finds no such place is left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled
from envs.grasp.scene.blocks import DISC_RADIUS_M
from envs.grasp.scene.boxes import Boxes, clear, move, outline, part, put, shows
from envs.grasp.scene.cable import CABLE_BOXES, draw_cable
from envs.grasp.scene.table_top import TableTop, take, take_block, take_corridor
from envs.grasp.scene.things import KIND_CODES, THING_BOXES, draw_thing
from envs.grasp.settings import MAX_THINGS, GraspSettings, Surroundings
from envs.grasp.threefry import uniform

Floats = NDArray[np.float64]
Stream = NDArray[np.uint64]

# Where in the K boxes of a scene each part has its own; those it does not use are zero.
FRAME = slice(0, 6)
THINGS = slice(FRAME.stop, FRAME.stop + MAX_THINGS * THING_BOXES)
CABLE = slice(THINGS.stop, THINGS.stop + CABLE_BOXES)
BACKDROP = slice(CABLE.stop, CABLE.stop + 6)
FLOOR = slice(BACKDROP.stop, BACKDROP.stop + 1)
BOXES = FLOOR.stop
ON_TABLE = slice(THINGS.start, CABLE.stop)
SOLID = (FRAME, ON_TABLE, BACKDROP)
"""What can be touched, by the room it takes. The floor can't: the robot stands on it, and no pose
of the workspace brings a moving link down to it."""

TRIES = 50
# Points of the grasp disc's rim that must be seen, beside its centre.
RIM_POINTS = 12
FLOOR_LOW_M, FLOOR_HIGH_M = (-1.5, -3.0, -0.05), (4.5, 3.0, 0.0)
# Numbers of a scene's stream that the placement of its blocks never comes to.
OWN_NUMBERS = np.uint64(2**63)


class SurroundingRules(NamedTuple):
    """The settings as plain numbers and arrays; ranges are (low, high). See `Surroundings`."""

    present: float
    floor: float
    frame: float
    wall: float
    rack: float
    distance_m: Floats
    yaw_rad: Floats
    cable: float
    cable_m: Floats
    things: NDArray[np.int64]
    kinds: NDArray[np.int64]
    block_size_m: Floats
    table_low_m: Floats
    table_high_m: Floats


def surrounding_rules(settings: GraspSettings, surroundings: Surroundings) -> SurroundingRules:
    """The rules of what stands around in a run's scenes."""
    support = settings.support
    low = [support.x_m[0], support.y_m[0], support.top_m - support.thickness_m]
    return SurroundingRules(
        present=surroundings.present,
        floor=surroundings.floor,
        frame=surroundings.frame,
        wall=surroundings.wall,
        rack=surroundings.rack,
        distance_m=np.array(surroundings.distance_m),
        yaw_rad=np.radians(surroundings.yaw_deg),
        cable=surroundings.cable,
        cable_m=np.array(surroundings.cable_m),
        things=np.array(surroundings.things),
        kinds=np.array([KIND_CODES[kind] for kind in surroundings.kinds]),
        block_size_m=np.array(settings.randomize.block_size_m),
        table_low_m=np.array(low),
        table_high_m=np.array([support.x_m[1], support.y_m[1], support.top_m]),
    )


@compiled(nogil=True)
def surround(
    rules: SurroundingRules,
    streams: NDArray[np.uint64],
    camera_m: Floats,
    block_center_m: Floats,
    block_half_m: Floats,
    position_m: Floats,
    yaw_rad: Floats,
    target_m: Floats,
    center_m: Floats,
    rotation: Floats,
    half_m: Floats,
    begin: int,
    end: int,
) -> None:
    """Draws what stands around the blocks of the scenes from `begin` to `end` of n.

    Args:
        rules: what is drawn.
        streams: (n, 2) each scene's source of randomness; see `threefry.uniform`.
        camera_m: (n, C, 3) the cameras' optical centres.
        block_center_m: (n, B, 3, 3) the blocks, as the following are: fields of `Scenes`.
        block_half_m: (n, B, 3, 3).
        position_m: (n, B, 3).
        yaw_rad: (n, B).
        target_m: (n, 3).
        center_m: (n, K, 3) written, as the following are: the boxes.
        rotation: (n, K, 3, 3).
        half_m: (n, K, 3).
        begin: the first row.
        end: the row after the last.
    """
    blocks = position_m.shape[1]
    room = blocks + 1 + MAX_THINGS + 1
    table = TableTop(rules.table_low_m, rules.table_high_m, np.empty((room, 4, 3)), np.empty(room))
    disc = np.empty((RIM_POINTS + 1, 3))
    for row in range(begin, end):
        center_m[row], rotation[row], half_m[row] = 0.0, 0.0, 0.0
        boxes, stream = Boxes(center_m[row], rotation[row], half_m[row]), streams[row]
        if uniform(stream, 0.0, 1.0) >= rules.present:
            continue
        _draw_far(stream, rules, boxes)
        for block in range(blocks):
            take_block(
                table,
                block,
                block_center_m[row, block],
                block_half_m[row, block],
                position_m[row, block],
                yaw_rad[row, block],
            )
        take_corridor(table, blocks, target_m[row], yaw_rad[row, 0])
        _write_disc(target_m[row], yaw_rad[row, 0], disc)
        count = _draw_things(stream, rules, boxes, table, blocks + 1, camera_m[row], disc)
        if uniform(stream, 0.0, 1.0) < rules.cable:
            cable = part(boxes, CABLE.start, CABLE.stop)
            draw_cable(stream, rules.cable_m, cable, table, count, camera_m[row], disc)


@compiled()
def _draw_far(stream: Stream, rules: SurroundingRules, boxes: Boxes) -> None:
    """Draws the floor, what stands behind the table, and what carries it."""
    if uniform(stream, 0.0, 1.0) < rules.floor:
        low, high = FLOOR_LOW_M, FLOOR_HIGH_M
        middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2)
        half = ((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2)
        put(boxes, FLOOR.start, middle, half, 0.0, 0.0)
    under = rules.table_low_m[2]
    if uniform(stream, 0.0, 1.0) < rules.frame and under > 0.0:
        _draw_frame(stream, rules, part(boxes, FRAME.start, FRAME.stop))
    which = uniform(stream, 0.0, 1.0)
    if which < rules.wall + rules.rack:
        _draw_backdrop(
            stream, rules, part(boxes, BACKDROP.start, BACKDROP.stop), which < rules.wall
        )


@compiled()
def _draw_frame(stream: Stream, rules: SurroundingRules, boxes: Boxes) -> None:
    """Four legs under the table's top, and an apron before and behind."""
    low, high, under = rules.table_low_m, rules.table_high_m, rules.table_low_m[2]
    leg, inset = uniform(stream, 0.02, 0.04), uniform(stream, 0.0, 0.06)
    apron = min(uniform(stream, 0.025, 0.06), under / 2)
    box = 0
    for x in (low[0] + inset + leg, high[0] - inset - leg):
        for y in (low[1] + inset + leg, high[1] - inset - leg):
            put(boxes, box, (x, y, under / 2), (leg, leg, under / 2), 0.0, 0.0)
            box += 1
        middle, side = (low[1] + high[1]) / 2, (high[1] - low[1]) / 2 - inset - leg
        put(boxes, box, (x, middle, under - apron), (0.01, side, apron), 0.0, 0.0)
        box += 1


@compiled()
def _draw_backdrop(stream: Stream, rules: SurroundingRules, boxes: Boxes, is_wall: bool) -> None:
    """A wall, or a rack of four posts and two shelves, wholly behind the table's far side."""
    yaw = uniform(stream, rules.yaw_rad[0], rules.yaw_rad[1])
    distance = uniform(stream, rules.distance_m[0], rules.distance_m[1])
    height, side = uniform(stream, 1.2, 2.2), uniform(stream, -0.4, 0.4)
    x, y = math.cos(yaw), math.sin(yaw)
    far = max(y * rules.table_low_m[1], y * rules.table_high_m[1]) + x * rules.table_high_m[0]
    place = np.array([x * (far + distance) - y * side, y * (far + distance) + x * side, 0.0])
    if is_wall:
        put(boxes, 0, (0.05, 0.0, height / 2), (0.05, 1.5, height / 2), 0.0, 0.0)
    else:
        width, depth = uniform(stream, 0.4, 0.8), uniform(stream, 0.15, 0.25)
        post, box = uniform(stream, 0.015, 0.025), 0
        for level in (uniform(stream, 0.2, 0.6), uniform(stream, 0.8, 1.1)):
            put(boxes, box, (depth, 0.0, level), (depth, width, 0.0125), 0.0, 0.0)
            box += 1
        for ahead in (post, 2 * depth - post):
            for across in (post - width, width - post):
                put(boxes, box, (ahead, across, height / 2), (post, post, height / 2), 0.0, 0.0)
                box += 1
    move(boxes, place, yaw)


@compiled()
def _write_disc(target_m: Floats, yaw_rad: float, points_m: Floats) -> None:
    """Writes the centre and the rim of the grasp disc on the target's face."""
    for point in range(len(points_m)):
        angle = 2.0 * math.pi * point / RIM_POINTS
        radius = DISC_RADIUS_M if point < RIM_POINTS else 0.0
        points_m[point, 0] = target_m[0] - math.sin(yaw_rad) * radius * math.cos(angle)
        points_m[point, 1] = target_m[1] + math.cos(yaw_rad) * radius * math.cos(angle)
        points_m[point, 2] = target_m[2] + radius * math.sin(angle)


@compiled()
def _draw_things(
    stream: Stream,
    rules: SurroundingRules,
    boxes: Boxes,
    table: TableTop,
    count: int,
    camera_m: Floats,
    disc_m: Floats,
) -> int:
    """Draws the things, and takes their places after `count`; returns how many are taken then."""
    number = int(uniform(stream, rules.things[0], rules.things[1] + 1))
    for thing in range(number):
        begin = THINGS.start + thing * THING_BOXES
        own = part(boxes, begin, begin + THING_BOXES)
        for _ in range(TRIES):
            clear(own)
            draw_thing(stream, rules.kinds, rules.block_size_m, own)
            if _settle(stream, own, table, count) and shows(own, camera_m, disc_m):
                count += 1
                break
            clear(own)
    return count


@compiled()
def _settle(stream: Stream, boxes: Boxes, table: TableTop, count: int) -> bool:
    """Puts a thing somewhere on the table, any way round; False where that is taken."""
    low, high = outline(boxes)
    size = np.array([high[0] - low[0], high[1] - low[1], 0.0])
    boxes.center_m[:, 0] -= low[0]
    boxes.center_m[:, 1] -= (low[1] + high[1]) / 2
    yaw = uniform(stream, -math.pi, math.pi)
    place = np.empty(3)
    for axis in range(2):
        place[axis] = uniform(stream, table.low_m[axis], table.high_m[axis])
    place[2] = table.high_m[2]
    move(boxes, place, yaw)
    return take(table, count, size, place, yaw)
