"""What stands around the blocks and is none of them: drawn scene by scene, all of it boxes.

Nothing here stands where a block does, nor in the way of the tool to the target, and nothing hides
the target's grasp disc from a camera. A thing that finds no such place is left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from envs.grasp.scene.blocks import DISC_RADIUS_M
from envs.grasp.scene.placement import footprint, separated
from envs.grasp.settings import MAX_THINGS, GraspSettings, Surroundings
from envs.grasp.threefry import uniform

Floats = NDArray[np.float64]
Stream = NDArray[np.uint64]
Point = tuple[float, float, float]

# Where in the K boxes of a scene each part has its own; those it does not use are zero.
THING_BOXES, CABLE_BOXES = 3, 5
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

T, CROSS, PLATE, POST, CUBE, SLAB, TILTED, COLUMN = range(8)
KIND_CODES = {
    "T": T,
    "cross": CROSS,
    "plate": PLATE,
    "post": POST,
    "cube": CUBE,
    "slab": SLAB,
    "tilted": TILTED,
    "column": COLUMN,
}
# Boxes that are no blocks have a face whose smaller side is this share of a block's at most.
SMALL_SHARE = 0.6
TALLEST_M = 0.35

# The way of a perfect tool, seen from above: the cup and the wrist come along the face's normal,
# the arm behind them from above. Of 60,000 posts up to 0.4 m high beside it none was touched.
CORRIDOR_HALF_M = 0.16
CORRIDOR_LENGTH_M = 1.5
CORRIDOR_BEYOND_M = 0.02
# Air between the footprints of what lies on the table.
CLEARANCE_M = 0.01
TRIES = 50
HANGING = 0.5
BEND_RAD = SWING_RAD = math.radians(25.0)
# Points of the grasp disc's rim that must be seen, beside its centre.
RIM_POINTS = 12
FLOOR_LOW_M, FLOOR_HIGH_M = (-1.5, -3.0, -0.05), (4.5, 3.0, 0.0)
# Numbers of a scene's stream that the placement of its blocks never comes to.
OWN_NUMBERS = np.uint64(2**63)


class Boxes(NamedTuple):
    """K boxes in the world frame, or those of one part: a size of zero where there is none."""

    center_m: Floats
    rotation: Floats
    half_m: Floats


class Taken(NamedTuple):
    """Rectangles of the table's top that are taken: corners (M, 4, 3) and yaws (M,).

    Each is half the clearance larger, on every side, than what takes it.
    """

    corners_m: Floats
    yaw_rad: Floats


class SurroundingRules(NamedTuple):
    """The settings as plain numbers and arrays; ranges are (low, high). See `Surroundings`."""

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


@numba.njit(cache=True, nogil=True)
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
    taken = Taken(np.empty((room, 4, 3)), np.empty(room))
    disc = np.empty((RIM_POINTS + 1, 3))
    for row in range(begin, end):
        center_m[row], rotation[row], half_m[row] = 0.0, 0.0, 0.0
        boxes, stream = Boxes(center_m[row], rotation[row], half_m[row]), streams[row]
        _draw_far(stream, rules, boxes)
        for block in range(blocks):
            _take_block(
                taken,
                block,
                block_center_m[row, block],
                block_half_m[row, block],
                position_m[row, block],
                yaw_rad[row, block],
            )
        _take_corridor(taken, blocks, target_m[row], yaw_rad[row, 0])
        _write_disc(target_m[row], yaw_rad[row, 0], disc)
        count = _draw_things(stream, rules, boxes, taken, blocks + 1, camera_m[row], disc)
        _draw_cable(stream, rules, boxes, taken, count, camera_m[row], disc)


@numba.njit(cache=True)
def part(boxes: Boxes, begin: int, end: int) -> Boxes:
    """The boxes from `begin` to `end`."""
    return Boxes(boxes.center_m[begin:end], boxes.rotation[begin:end], boxes.half_m[begin:end])


@numba.njit(cache=True)
def _put(
    boxes: Boxes, box: int, center_m: Point, half_m: Point, yaw_rad: float, pitch_rad: float
) -> None:
    """Writes a box that is first pitched about y, its top towards +x, then turned by its yaw."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    level, steep = math.cos(pitch_rad), math.sin(pitch_rad)
    turn = boxes.rotation[box]
    turn[0, 0], turn[0, 1], turn[0, 2] = cosine * level, -sine, cosine * steep
    turn[1, 0], turn[1, 1], turn[1, 2] = sine * level, cosine, sine * steep
    turn[2, 0], turn[2, 1], turn[2, 2] = -steep, 0.0, level
    for axis in range(3):
        boxes.center_m[box, axis], boxes.half_m[box, axis] = center_m[axis], half_m[axis]


@numba.njit(cache=True)
def _move(boxes: Boxes, position_m: Floats, yaw_rad: float) -> None:
    """Turns boxes about the origin's vertical, then moves them there."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    for box in range(len(boxes.half_m)):
        x, y = boxes.center_m[box, 0], boxes.center_m[box, 1]
        boxes.center_m[box, 0] = position_m[0] + cosine * x - sine * y
        boxes.center_m[box, 1] = position_m[1] + sine * x + cosine * y
        boxes.center_m[box, 2] += position_m[2]
        for column in range(3):
            x, y = boxes.rotation[box, 0, column], boxes.rotation[box, 1, column]
            boxes.rotation[box, 0, column] = cosine * x - sine * y
            boxes.rotation[box, 1, column] = sine * x + cosine * y


@numba.njit(cache=True)
def _clear(boxes: Boxes) -> None:
    boxes.center_m[:], boxes.rotation[:], boxes.half_m[:] = 0.0, 0.0, 0.0


# -- around the table ------------------------------------------------------------------------------


@numba.njit(cache=True)
def _draw_far(stream: Stream, rules: SurroundingRules, boxes: Boxes) -> None:
    """Draws the floor, what stands behind the table, and what carries it."""
    if uniform(stream, 0.0, 1.0) < rules.floor:
        low, high = FLOOR_LOW_M, FLOOR_HIGH_M
        middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2)
        half = ((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2)
        _put(boxes, FLOOR.start, middle, half, 0.0, 0.0)
    under = rules.table_low_m[2]
    if uniform(stream, 0.0, 1.0) < rules.frame and under > 0.0:
        _draw_frame(stream, rules, part(boxes, FRAME.start, FRAME.stop))
    which = uniform(stream, 0.0, 1.0)
    if which < rules.wall + rules.rack:
        _draw_backdrop(
            stream, rules, part(boxes, BACKDROP.start, BACKDROP.stop), which < rules.wall
        )


@numba.njit(cache=True)
def _draw_frame(stream: Stream, rules: SurroundingRules, boxes: Boxes) -> None:
    """Four legs under the table's top, and an apron before and behind."""
    low, high, under = rules.table_low_m, rules.table_high_m, rules.table_low_m[2]
    leg, inset = uniform(stream, 0.02, 0.04), uniform(stream, 0.0, 0.06)
    apron = min(uniform(stream, 0.025, 0.06), under / 2)
    box = 0
    for x in (low[0] + inset + leg, high[0] - inset - leg):
        for y in (low[1] + inset + leg, high[1] - inset - leg):
            _put(boxes, box, (x, y, under / 2), (leg, leg, under / 2), 0.0, 0.0)
            box += 1
        middle, side = (low[1] + high[1]) / 2, (high[1] - low[1]) / 2 - inset - leg
        _put(boxes, box, (x, middle, under - apron), (0.01, side, apron), 0.0, 0.0)
        box += 1


@numba.njit(cache=True)
def _draw_backdrop(stream: Stream, rules: SurroundingRules, boxes: Boxes, is_wall: bool) -> None:
    """A wall, or a rack of four posts and two shelves, wholly behind the table's far side."""
    yaw = uniform(stream, rules.yaw_rad[0], rules.yaw_rad[1])
    distance = uniform(stream, rules.distance_m[0], rules.distance_m[1])
    height, side = uniform(stream, 1.2, 2.2), uniform(stream, -0.4, 0.4)
    x, y = math.cos(yaw), math.sin(yaw)
    far = max(y * rules.table_low_m[1], y * rules.table_high_m[1]) + x * rules.table_high_m[0]
    place = np.array([x * (far + distance) - y * side, y * (far + distance) + x * side, 0.0])
    if is_wall:
        _put(boxes, 0, (0.05, 0.0, height / 2), (0.05, 1.5, height / 2), 0.0, 0.0)
    else:
        width, depth = uniform(stream, 0.4, 0.8), uniform(stream, 0.15, 0.25)
        post, box = uniform(stream, 0.015, 0.025), 0
        for level in (uniform(stream, 0.2, 0.6), uniform(stream, 0.8, 1.1)):
            _put(boxes, box, (depth, 0.0, level), (depth, width, 0.0125), 0.0, 0.0)
            box += 1
        for ahead in (post, 2 * depth - post):
            for across in (post - width, width - post):
                _put(boxes, box, (ahead, across, height / 2), (post, post, height / 2), 0.0, 0.0)
                box += 1
    _move(boxes, place, yaw)


# -- on the table ----------------------------------------------------------------------------------


@numba.njit(cache=True)
def _take_block(
    taken: Taken,
    place: int,
    center_m: Floats,
    half_m: Floats,
    position_m: Floats,
    yaw_rad: float,
) -> None:
    """Takes the footprint of a block; its first box is as wide and deep as the whole."""
    size = np.array([2.0 * half_m[0, 0], 2.0 * half_m[0, 1], 0.0])
    footprint(size, position_m, yaw_rad, CLEARANCE_M / 2, taken.corners_m[place])
    taken.yaw_rad[place] = yaw_rad


@numba.njit(cache=True)
def _take_corridor(taken: Taken, place: int, target_m: Floats, yaw_rad: float) -> None:
    """Takes the way of the tool: it comes from the robot's side along the face's normal."""
    size = np.array([CORRIDOR_LENGTH_M + CORRIDOR_BEYOND_M, 2.0 * CORRIDOR_HALF_M, 0.0])
    start = target_m.copy()
    start[0] -= CORRIDOR_LENGTH_M * math.cos(yaw_rad)
    start[1] -= CORRIDOR_LENGTH_M * math.sin(yaw_rad)
    footprint(size, start, yaw_rad, CLEARANCE_M / 2, taken.corners_m[place])
    taken.yaw_rad[place] = yaw_rad


@numba.njit(cache=True)
def _write_disc(target_m: Floats, yaw_rad: float, points_m: Floats) -> None:
    """Writes the centre and the rim of the grasp disc on the target's face."""
    for point in range(len(points_m)):
        angle = 2.0 * math.pi * point / RIM_POINTS
        radius = DISC_RADIUS_M if point < RIM_POINTS else 0.0
        points_m[point, 0] = target_m[0] - math.sin(yaw_rad) * radius * math.cos(angle)
        points_m[point, 1] = target_m[1] + math.cos(yaw_rad) * radius * math.cos(angle)
        points_m[point, 2] = target_m[2] + radius * math.sin(angle)


@numba.njit(cache=True)
def _draw_things(
    stream: Stream,
    rules: SurroundingRules,
    boxes: Boxes,
    taken: Taken,
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
            _clear(own)
            _draw_thing(stream, rules, own)
            if _settle(stream, rules, own, taken, count) and _shows(own, camera_m, disc_m):
                count += 1
                break
            _clear(own)
    return count


@numba.njit(cache=True)
def _settle(
    stream: Stream, rules: SurroundingRules, boxes: Boxes, taken: Taken, count: int
) -> bool:
    """Puts a thing somewhere on the table, any way round; False where that is taken."""
    low, high = _outline(boxes)
    size = np.array([high[0] - low[0], high[1] - low[1], 0.0])
    boxes.center_m[:, 0] -= low[0]
    boxes.center_m[:, 1] -= (low[1] + high[1]) / 2
    yaw = uniform(stream, -math.pi, math.pi)
    place = np.empty(3)
    for axis in range(2):
        place[axis] = uniform(stream, rules.table_low_m[axis], rules.table_high_m[axis])
    place[2] = rules.table_high_m[2]
    _move(boxes, place, yaw)
    return _take(rules, taken, count, size, place, yaw)


@numba.njit(cache=True)
def _outline(boxes: Boxes) -> tuple[Floats, Floats]:
    """The ends (3,) of the room that boxes take."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for box in range(len(boxes.half_m)):
        if boxes.half_m[box, 0] == 0.0:
            continue
        for axis in range(3):
            reach = 0.0
            for k in range(3):
                reach += abs(boxes.rotation[box, axis, k]) * boxes.half_m[box, k]
            low[axis] = min(low[axis], boxes.center_m[box, axis] - reach)
            high[axis] = max(high[axis], boxes.center_m[box, axis] + reach)
    return low, high


@numba.njit(cache=True)
def _take(
    rules: SurroundingRules,
    taken: Taken,
    count: int,
    size_m: Floats,
    position_m: Floats,
    yaw_rad: float,
) -> bool:
    """Takes a rectangle of the table's top, unless any of it is taken or beside the table."""
    corners = taken.corners_m[count]
    footprint(size_m, position_m, yaw_rad, 0.0, corners)
    for corner in range(4):
        for axis in range(2):
            if not rules.table_low_m[axis] <= corners[corner, axis] <= rules.table_high_m[axis]:
                return False
    footprint(size_m, position_m, yaw_rad, CLEARANCE_M / 2, corners)
    taken.yaw_rad[count] = yaw_rad
    for other in range(count):
        theirs = taken.corners_m[other]
        if not (
            separated(corners, theirs, yaw_rad) or separated(corners, theirs, taken.yaw_rad[other])
        ):
            return False
    return True


@numba.njit(cache=True)
def _shows(boxes: Boxes, camera_m: Floats, points_m: Floats) -> bool:
    """Whether every camera sees all of some points past boxes."""
    for box in range(len(boxes.half_m)):
        if boxes.half_m[box, 0] == 0.0:
            continue
        for camera in range(len(camera_m)):
            for point in range(len(points_m)):
                if _crosses(boxes, box, camera_m[camera], points_m[point]):
                    return False
    return True


@numba.njit(cache=True)
def _crosses(boxes: Boxes, box: int, start_m: Floats, end_m: Floats) -> bool:
    """Whether a box has a point of a straight line, by the part of it between its faces."""
    enter, leave = 0.0, 1.0
    for k in range(3):
        along = offset = 0.0
        for axis in range(3):
            turn = boxes.rotation[box, axis, k]
            along += turn * (end_m[axis] - start_m[axis])
            offset += turn * (start_m[axis] - boxes.center_m[box, axis])
        half = boxes.half_m[box, k]
        if abs(along) < 1e-12:
            if abs(offset) > half:
                return False
            continue
        first, second = (-half - offset) / along, (half - offset) / along
        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    return enter <= leave


@numba.njit(cache=True)
def _draw_thing(stream: Stream, rules: SurroundingRules, boxes: Boxes) -> None:
    """Draws a thing that stands at the origin."""
    kind = rules.kinds[int(uniform(stream, 0.0, len(rules.kinds)))]
    if kind in (T, CROSS):
        _draw_beams(stream, rules, boxes, kind)
    elif kind == COLUMN:
        _draw_column(stream, rules, boxes)
    elif kind == TILTED:
        _draw_tilted(stream, rules, boxes)
    else:
        _draw_box(stream, rules, boxes, kind)


@numba.njit(cache=True)
def _draw_beams(stream: Stream, rules: SurroundingRules, boxes: Boxes, kind: int) -> None:
    """A T, upright or on its head, or a cross: a thin upright and a beam across its middle line."""
    low, high = rules.block_size_m
    width, height = uniform(stream, low, high) / 2, uniform(stream, low, high) / 2
    depth, thick = uniform(stream, 0.015, 0.05), low * uniform(stream, 0.1, 0.15)
    across = 2 * height - thick if uniform(stream, 0.0, 1.0) < 0.5 else thick
    if kind == CROSS:
        across = 2 * height * uniform(stream, 0.4, 0.6)
    _put(boxes, 0, (0.0, 0.0, height), (depth, thick, height), 0.0, 0.0)
    _put(boxes, 1, (0.0, 0.0, across), (depth, width, thick), 0.0, 0.0)


@numba.njit(cache=True)
def _draw_column(stream: Stream, rules: SurroundingRules, boxes: Boxes) -> None:
    """A hexagonal column: three boxes about one axis, each with two opposite sides of it."""
    inner = SMALL_SHARE * rules.block_size_m[0] * uniform(stream, 0.4, 0.8)
    height = uniform(stream, 0.03, TALLEST_M / 2 - 0.05)
    for box in range(3):
        half = (inner, inner * math.tan(math.pi / 6), height)
        _put(boxes, box, (0.0, 0.0, height), half, box * math.pi / 3, 0.0)


@numba.njit(cache=True)
def _draw_tilted(stream: Stream, rules: SurroundingRules, boxes: Boxes) -> None:
    """A box on one of its edges: no face of it is upright, but for the ends."""
    depth, height = uniform(stream, 0.02, 0.05), uniform(stream, 0.04, 0.08)
    width, pitch = uniform(stream, 0.03, 0.12), math.radians(uniform(stream, 20.0, 45.0))
    up = height * math.cos(pitch) + depth * math.sin(pitch)
    _put(boxes, 0, (0.0, 0.0, up), (depth, width, height), 0.0, pitch)


@numba.njit(cache=True)
def _draw_box(stream: Stream, rules: SurroundingRules, boxes: Boxes, kind: int) -> None:
    """A plate, a post, a cube or a slab: upright boxes, all of whose faces have a small side."""
    low, high = rules.block_size_m
    small = SMALL_SHARE * low
    width, height = uniform(stream, small, high) / 2, uniform(stream, 0.4, 1.0) * small / 2
    depth = uniform(stream, 0.004, 0.01)
    if kind == POST:
        width = depth = uniform(stream, 0.008, 0.02)
        height = uniform(stream, low, TALLEST_M) / 2
    elif kind == CUBE:
        width = depth = height
    elif kind == SLAB:
        depth, height = uniform(stream, small, high) / 2, uniform(stream, 0.005, 0.02)
    _put(boxes, 0, (0.0, 0.0, height), (depth, width, height), 0.0, 0.0)


# -- the cable -------------------------------------------------------------------------------------


@numba.njit(cache=True)
def _draw_cable(
    stream: Stream,
    rules: SurroundingRules,
    boxes: Boxes,
    taken: Taken,
    count: int,
    camera_m: Floats,
    disc_m: Floats,
) -> None:
    """Draws a cable on the table, from place `count` of those that are taken on; or none."""
    if uniform(stream, 0.0, 1.0) >= rules.cable:
        return
    half = uniform(stream, rules.cable_m[0], rules.cable_m[1]) / 2
    own = part(boxes, CABLE.start, CABLE.stop)
    hangs, end = uniform(stream, 0.0, 1.0) < HANGING, np.empty(3)
    for _ in range(TRIES):
        _clear(own)
        if hangs:
            first = _hang(stream, rules, own, half, end)
        else:
            first = _begin_anywhere(stream, rules, end)
        if _lay(stream, rules, own, first, half, end, taken, count) and _shows(
            own, camera_m, disc_m
        ):
            return
    _clear(own)


@numba.njit(cache=True)
def _begin_anywhere(stream: Stream, rules: SurroundingRules, end: Floats) -> int:
    """Begins a cable on the table: writes x, y and the heading of its free end."""
    for axis in range(2):
        end[axis] = uniform(stream, rules.table_low_m[axis], rules.table_high_m[axis])
    end[2] = uniform(stream, -math.pi, math.pi)
    return 0


@numba.njit(cache=True)
def _hang(stream: Stream, rules: SurroundingRules, boxes: Boxes, half_m: float, end: Floats) -> int:
    """Hangs two boxes of a cable over a side of the table or its far edge.

    Writes x, y and the heading of the end that lies on the table; returns the number of boxes.
    """
    low, high = rules.table_low_m, rules.table_high_m
    x, y = uniform(stream, low[0], high[0]), uniform(stream, low[1], high[1])
    edge = int(uniform(stream, 0.0, 3.0))
    if edge == 0:
        x, out = high[0], 0.0
    else:
        y, out = (high[1], math.pi / 2) if edge == 1 else (low[1], -math.pi / 2)
    down, on = uniform(stream, 0.08, 0.2), uniform(stream, 0.08, 0.2)
    ahead, aside = math.cos(out), math.sin(out)
    end[0], end[1], end[2] = x - half_m * ahead, y - half_m * aside, out + math.pi
    x, y, z = x + half_m * ahead, y + half_m * aside, high[2] + 2.0 * half_m - down
    _put(boxes, 0, (x, y, z + down / 2), (half_m, half_m, down / 2), out, 0.0)
    # The lower part swings along the edge.
    swing = uniform(stream, -SWING_RAD, SWING_RAD)
    x += on / 2 * math.sin(swing) * aside
    y -= on / 2 * math.sin(swing) * ahead
    z -= on / 2 * math.cos(swing)
    _put(boxes, 1, (x, y, z), (half_m, half_m, on / 2), out + math.pi / 2, swing)
    return 2


@numba.njit(cache=True)
def _lay(
    stream: Stream,
    rules: SurroundingRules,
    boxes: Boxes,
    first: int,
    half_m: float,
    end: Floats,
    taken: Taken,
    count: int,
) -> bool:
    """Lays the boxes from `first` on, each from the end of the one before; False if one can't."""
    for box in range(first, CABLE_BOXES):
        yaw = end[2] + uniform(stream, -BEND_RAD, BEND_RAD)
        length = uniform(stream, 0.05, 0.12)
        start = np.array([end[0], end[1], rules.table_high_m[2]])
        if not _take(rules, taken, count, np.array([length, 2.0 * half_m, 0.0]), start, yaw):
            return False
        x, y = math.cos(yaw), math.sin(yaw)
        middle = (start[0] + length / 2 * x, start[1] + length / 2 * y, start[2] + half_m)
        # Longer by half its thickness at both ends, so that no bend has a gap.
        _put(boxes, box, middle, (length / 2 + half_m, half_m, half_m), yaw, 0.0)
        end[0], end[1], end[2] = start[0] + length * x, start[1] + length * y, yaw
    return True
