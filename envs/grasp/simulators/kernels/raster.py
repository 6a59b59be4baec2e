"""Draws boxes and cylinders into one picture, by rays through the pixels' centres.

A picture holds inverse depths (1/m, 0 where nothing is): on a plane they are an affine function of
column and row, so that the nearest of all faces costs a multiplication, an addition and a maximum
a pixel. A box's face is the intersection of half planes, which cut every row to a span.

Surfaces are seen from outside only, and only between the clip planes: an object that holds the
camera, or that the near plane cuts, is seen through there, as by PyBullet's TinyRenderer.

All points and directions are in camera axes (x right, y down, z forward), in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.simulators.kernels.worlds import Floats, Vector, dot, kernel

Pixels = NDArray[np.float32]
Colors = NDArray[np.int32]

# All of fast math but the promise that there are no infinities and NaNs.
FAST = {"contract", "reassoc", "nsz", "arcp", "afn"}
# Loops over a multiple of so many pixels become vectors without a slow remainder; what is drawn
# into has so many pixels behind its end.
LANES = 16
# A pixel whose centre lies on an edge is drawn by both its faces, rather than by none.
EDGE_SLACK_PX = 1e-6
PARALLEL = 1e-14
NOWHERE_PX = 1e30
# The color of a pixel whose color is not known yet.
UNSHADED = np.int32(-1)
# Nearer than this to the camera's plane a corner has no place in the picture.
MIN_CORNER_DEPTH_M = 1e-3


class Lens(NamedTuple):
    """A pinhole camera: where its rays go, and between which planes it sees."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near_m: float
    far_m: float


class Light(NamedTuple):
    """Lambert's shading: a unit vector towards the light, and the shares of the intensity."""

    direction: Vector
    ambient: float
    diffuse: float


class Canvas(NamedTuple):
    """One picture, row by row, with `LANES` pixels behind its end, and room to work in.

    Attributes:
        inverse: (H * W + LANES,) inverse depths.
        colors: the same of packed colors, 0xRRGGBB; empty where only depth is wanted.
        low, high: (H + LANES,) span of each row.
        lines: (4, 6) of a face's edges: slope and offset of the low and of the high ends.
    """

    inverse: Pixels
    colors: Colors
    low: Floats
    high: Floats
    lines: Floats


class Slab(NamedTuple):
    """Ends of a solid along one of its axes.

    The point at depth z on the ray of pixel (column, row) lies at z * (right * column + down * row
    + start) along the axis, and the solid from `middle - half` to `middle + half`.
    """

    right: float
    down: float
    start: float
    middle: float
    half: float


class Rectangle(NamedTuple):
    """The pixels from first to before end; empty where the ends are not behind the firsts."""

    first_column: int
    end_column: int
    first_row: int
    end_row: int


@kernel()
def canvas(height: int, width: int, colored: bool) -> Canvas:
    """An empty picture."""
    size = height * width + LANES
    return Canvas(
        np.zeros(size, np.float32),
        np.zeros(size if colored else 0, np.int32),
        np.empty(height + LANES),
        np.empty(height + LANES),
        np.empty((4, 6)),
    )


@kernel(counts=False)
def shaded(color: Vector, cosine: float, light: Light) -> int:
    """A color in [0, 255] whose normal has this cosine to the light, packed as 0xRRGGBB."""
    intensity = light.ambient + light.diffuse * max(0.0, cosine)
    red = min(255, int(color[0] * intensity))
    green = min(255, int(color[1] * intensity))
    return (red << 16) | (green << 8) | min(255, int(color[2] * intensity))


@kernel(counts=False)
def in_sight(center: Vector, radius: float, lens: Lens) -> bool:
    """Whether a ball reaches into the frustum's six half spaces."""
    x, y, z = center
    if z + radius < lens.near_m or z - radius > lens.far_m:
        return False
    return (
        _inside(x, z, (lens.width - lens.cx) / lens.fx, radius)
        and _inside(-x, z, lens.cx / lens.fx, radius)
        and _inside(y, z, (lens.height - lens.cy) / lens.fy, radius)
        and _inside(-y, z, lens.cy / lens.fy, radius)
    )


@kernel(counts=False)
def _inside(x: float, z: float, tangent: float, radius: float) -> bool:
    """Whether a ball at x to the side reaches into the half space x <= tangent * z."""
    return x - tangent * z <= radius * math.sqrt(1.0 + tangent * tangent)


@kernel(counts=False)
def _covered(
    center: Vector, x_axis: Vector, y_axis: Vector, z_axis: Vector, half: Vector, lens: Lens
) -> Rectangle:
    """The pixels a box can cover: all of them where it reaches behind the camera."""
    low_u = low_v = NOWHERE_PX
    high_u = high_v = -NOWHERE_PX
    for corner in range(8):
        x = half[0] if corner & 1 else -half[0]
        y = half[1] if corner & 2 else -half[1]
        z = half[2] if corner & 4 else -half[2]
        depth = center[2] + x_axis[2] * x + y_axis[2] * y + z_axis[2] * z
        if depth < MIN_CORNER_DEPTH_M:
            return Rectangle(0, lens.width, 0, lens.height)
        u = lens.fx / depth * (center[0] + x_axis[0] * x + y_axis[0] * y + z_axis[0] * z)
        v = lens.fy / depth * (center[1] + x_axis[1] * x + y_axis[1] * y + z_axis[1] * z)
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
    # From the pixels whose centres lie inside to those before and behind them.
    low_u, high_u = low_u + lens.cx - 1.0, high_u + lens.cx + 1.0
    low_v, high_v = low_v + lens.cy - 1.0, high_v + lens.cy + 1.0
    return Rectangle(
        int(max(0.0, low_u)),
        int(max(0.0, min(float(lens.width), high_u))),
        int(max(0.0, low_v)),
        int(max(0.0, min(float(lens.height), high_v))),
    )


@kernel(counts=False)
def _slab(axis: Vector, center: Vector, half: float, lens: Lens) -> Slab:
    right, down = axis[0] / lens.fx, axis[1] / lens.fy
    start = axis[2] + (0.5 - lens.cx) * right + (0.5 - lens.cy) * down
    return Slab(right, down, start, dot(axis, center), half)


@kernel(counts=False)
def _cut(lines: Floats, edge: int, right: float, down: float, start: float) -> None:
    """Notes where a row's span begins or ends: right * column + down * row + start >= 0."""
    if abs(right) < PARALLEL:
        right = PARALLEL
    scale = -1.0 / right
    slope, offset = down * scale, start * scale
    if right > 0.0:
        lines[0, edge], lines[1, edge] = slope, offset - EDGE_SLACK_PX
        lines[2, edge], lines[3, edge] = 0.0, NOWHERE_PX
    else:
        lines[0, edge], lines[1, edge] = 0.0, -NOWHERE_PX
        lines[2, edge], lines[3, edge] = slope, offset + EDGE_SLACK_PX


@kernel(counts=False, fastmath=FAST)
def _cut_rows(lines: Floats, lows: Floats, highs: Floats, rows: Rectangle, width: int) -> None:
    """Spans of the rows from the face's six edges, which are unrolled to become vectors."""
    a0, a1, a2, a3, a4, a5 = (lines[0, 0], lines[0, 1], lines[0, 2], lines[0, 3], lines[0, 4], lines[0, 5])  # fmt: skip # noqa: E501
    b0, b1, b2, b3, b4, b5 = (lines[1, 0], lines[1, 1], lines[1, 2], lines[1, 3], lines[1, 4], lines[1, 5])  # fmt: skip # noqa: E501
    c0, c1, c2, c3, c4, c5 = (lines[2, 0], lines[2, 1], lines[2, 2], lines[2, 3], lines[2, 4], lines[2, 5])  # fmt: skip # noqa: E501
    d0, d1, d2, d3, d4, d5 = (lines[3, 0], lines[3, 1], lines[3, 2], lines[3, 3], lines[3, 4], lines[3, 5])  # fmt: skip # noqa: E501
    last, first_row, count = width - 1.0, np.int32(rows.first_row), rows.end_row - rows.first_row
    for i in range((np.uint32(count) + np.uint32(LANES - 1)) & ~np.uint32(LANES - 1)):
        row = float(np.int32(i) + first_row)
        low, high = max(0.0, a0 * row + b0), min(last, c0 * row + d0)
        low, high = max(low, a1 * row + b1), min(high, c1 * row + d1)
        low, high = max(low, a2 * row + b2), min(high, c2 * row + d2)
        low, high = max(low, a3 * row + b3), min(high, c3 * row + d3)
        low, high = max(low, a4 * row + b4), min(high, c4 * row + d4)
        low, high = max(low, a5 * row + b5), min(high, c5 * row + d5)
        lows[i], highs[i] = low, high


@kernel(counts=False, fastmath=FAST)
def _fill(
    inverse: Pixels, lows: Floats, highs: Floats, plane: Vector, rows: Rectangle, width: int
) -> None:
    """Puts the nearest of what is there and of a plane into the rows' spans.

    Args:
        inverse: the picture's inverse depths. The pixels behind a span, up to a multiple of
            `LANES`, keep what they have.
        lows: where the rows' spans begin.
        highs: where they end.
        plane: what the plane's inverse depth rises by along columns and along rows, and where it
            starts.
        rows: of which the rows are filled.
        width: the picture's.
    """
    slope = np.float32(plane[0])
    for row in range(rows.first_row, rows.end_row):
        low, high = lows[row - rows.first_row], highs[row - rows.first_row]
        if low > high:
            continue
        begin = math.ceil(low)
        count = math.floor(high) + 1 - begin
        if count <= 0:
            continue
        start = np.float32(plane[0] * begin + plane[1] * row + plane[2])
        offset, limit = np.uint32(row * width + begin), np.int32(count)
        for i in range((np.uint32(count) + np.uint32(LANES - 1)) & ~np.uint32(LANES - 1)):
            column = np.int32(i)
            here = start + slope * np.float32(column)
            here = here if column < limit else np.float32(0.0)
            old = inverse[offset + i]
            inverse[offset + i] = here if here > old else old


@kernel(counts=False, fastmath=FAST)
def _fill_colored(
    inverse: Pixels,
    colors: Colors,
    lows: Floats,
    highs: Floats,
    plane: Vector,
    rows: Rectangle,
    width: int,
    color: int,
) -> None:
    """As `_fill`, and with a color."""
    slope, paint = np.float32(plane[0]), np.int32(color)
    for row in range(rows.first_row, rows.end_row):
        low, high = lows[row - rows.first_row], highs[row - rows.first_row]
        if low > high:
            continue
        begin = math.ceil(low)
        count = math.floor(high) + 1 - begin
        if count <= 0:
            continue
        start = np.float32(plane[0] * begin + plane[1] * row + plane[2])
        offset, limit = np.uint32(row * width + begin), np.int32(count)
        for i in range((np.uint32(count) + np.uint32(LANES - 1)) & ~np.uint32(LANES - 1)):
            column = np.int32(i)
            here = start + slope * np.float32(column)
            here = here if column < limit else np.float32(0.0)
            old, before = inverse[offset + i], colors[offset + i]
            inverse[offset + i] = here if here > old else old
            colors[offset + i] = paint if here > old else before


@kernel(counts=False)
def _draw_face(
    picture: Canvas,
    across: Slab,
    first: Slab,
    second: Slab,
    color: int,
    rows: Rectangle,
    lens: Lens,
) -> None:
    """Draws the face of a box that looks along the axis `across`, on the camera's side."""
    distance = across.middle - math.copysign(across.half, across.middle)
    # On the face, z * (n . ray) = distance: the inverse depth is affine.
    a, b, c = across.right / distance, across.down / distance, across.start / distance
    lines = picture.lines
    _cut(lines, 0, a, b, c - 1.0 / lens.far_m)
    _cut(lines, 1, -a, -b, 1.0 / lens.near_m - c)
    edge = 2
    for slab in (first, second):
        # middle - half <= z * (n . ray) <= middle + half, times the inverse depth
        end = slab.middle - slab.half
        _cut(lines, edge, slab.right - end * a, slab.down - end * b, slab.start - end * c)
        end = slab.middle + slab.half
        _cut(lines, edge + 1, end * a - slab.right, end * b - slab.down, end * c - slab.start)
        edge += 2
    lows, highs = picture.low, picture.high
    _cut_rows(lines, lows, highs, rows, lens.width)
    plane = (a, b, c)
    if picture.colors.size:
        _fill_colored(picture.inverse, picture.colors, lows, highs, plane, rows, lens.width, color)
    else:
        _fill(picture.inverse, lows, highs, plane, rows, lens.width)


@kernel(counts=False)
def draw_box(
    picture: Canvas,
    center: Vector,
    x_axis: Vector,
    y_axis: Vector,
    z_axis: Vector,
    half: Vector,
    color: Vector,
    lens: Lens,
    light: Light,
) -> None:
    """Draws a box.

    Args:
        picture: what it is drawn into.
        center: of the box.
        x_axis: unit vector along its first sides.
        y_axis: along its second.
        z_axis: along its third.
        half: half extents along them.
        color: in [0, 255].
        lens: the camera.
        light: of the colors.
    """
    covered = _covered(center, x_axis, y_axis, z_axis, half, lens)
    if covered.first_column >= covered.end_column or covered.first_row >= covered.end_row:
        return
    x = _slab(x_axis, center, half[0], lens)
    y = _slab(y_axis, center, half[1], lens)
    z = _slab(z_axis, center, half[2], lens)
    for _ in range(3):
        # From between the planes of a pair of faces, neither is seen from outside.
        if abs(x.middle) > x.half:
            cosine = -math.copysign(1.0, x.middle) * dot(x_axis, light.direction)
            _draw_face(picture, x, y, z, shaded(color, cosine, light), covered, lens)
        x, y, z = y, z, x
        x_axis, y_axis, z_axis = y_axis, z_axis, x_axis


@kernel(counts=False)
def draw_cylinder(
    picture: Canvas,
    center: Vector,
    x_axis: Vector,
    y_axis: Vector,
    z_axis: Vector,
    half: Vector,
    color: Vector,
    lens: Lens,
    light: Light,
) -> None:
    """Draws a cylinder along its z axis; `half` is (radius, radius, half length). See `draw_box`.

    Its colors are those of TinyRenderer, whose normals point from the centre to the surface.
    """
    covered = _covered(center, x_axis, y_axis, z_axis, half, lens)
    if covered.first_column >= covered.end_column:
        return
    along, radius, length = dot(z_axis, center), half[0], half[2]
    # From within the infinite tube only an end is seen, and from between the ends only the tube.
    tube = dot(center, center) - along * along > radius * radius
    cap = -math.copysign(length, along) if abs(along) > length else NOWHERE_PX
    for row in range(covered.first_row, covered.end_row):
        _cylinder_row(picture, covered, row, center, z_axis, (radius, length, cap), tube, lens)
        if picture.colors.size:
            _shade_row(picture, covered, row, center, color, lens, light)


@kernel(counts=False, fastmath=FAST)
def _cylinder_row(
    picture: Canvas,
    covered: Rectangle,
    row: int,
    center: Vector,
    axis: Vector,
    size: Vector,
    tube: bool,
    lens: Lens,
) -> None:
    """Draws a row of a cylinder of a radius, half a length, and with an end at `cap`.

    Rays are followed from where they reach the depth of the centre, so that all numbers are small.
    """
    nx, ny, nz = np.float32(axis[0]), np.float32(axis[1]), np.float32(axis[2])
    cx, cz = np.float32(center[0]), np.float32(center[2])
    radius, length, cap = np.float32(size[0]), np.float32(size[1]), np.float32(size[2])
    near, far = np.float32(lens.near_m), np.float32(lens.far_m)
    step = np.float32(1.0 / lens.fx)
    first = np.float32((covered.first_column + 0.5 - lens.cx) / lens.fx)
    ry = np.float32((row + 0.5 - lens.cy) / lens.fy)
    oy = np.float32(center[2] * ((row + 0.5 - lens.cy) / lens.fy) - center[1])
    offset = np.uint32(row * lens.width + covered.first_column)
    count = covered.end_column - covered.first_column
    colored = picture.colors.size > 0
    one, none = np.float32(1.0), np.float32(0.0)
    for i in range((np.uint32(count) + np.uint32(LANES - 1)) & ~np.uint32(LANES - 1)):
        column = np.int32(i)
        rx = first + step * np.float32(column)
        ox = cz * rx - cx
        rise, height = nx * rx + ny * ry + nz, nx * ox + ny * oy
        # |o + t r|^2 - (n . (o + t r))^2 = radius^2
        quadratic = rx * rx + ry * ry + one - rise * rise
        linear = ox * rx + oy * ry - height * rise
        root = linear * linear - quadratic * (ox * ox + oy * oy - height * height - radius * radius)
        side = (-linear - np.sqrt(max(root, none))) / quadratic
        on_side = tube & (root >= none) & (abs(height + side * rise) <= length)
        end = (cap - height) / rise
        ex, ey = ox + end * rx, oy + end * ry
        on_end = ex * ex + ey * ey + end * end <= radius * radius + length * length
        depth = cz + (side if on_side else end)
        seen = (on_side | on_end) & (depth >= near) & (depth <= far) & (column < np.int32(count))
        here = one / depth if seen else none
        old = picture.inverse[offset + i]
        picture.inverse[offset + i] = here if here > old else old
        if colored:
            before = picture.colors[offset + i]
            picture.colors[offset + i] = UNSHADED if here > old else before


@kernel(counts=False)
def _shade_row(
    picture: Canvas,
    covered: Rectangle,
    row: int,
    center: Vector,
    color: Vector,
    lens: Lens,
    light: Light,
) -> None:
    """Gives the pixels of a cylinder their colors."""
    for column in range(covered.first_column, covered.end_column):
        pixel = row * lens.width + column
        if picture.colors[pixel] != UNSHADED:
            continue
        depth = 1.0 / picture.inverse[pixel]
        x = depth * (column + 0.5 - lens.cx) / lens.fx - center[0]
        y = depth * (row + 0.5 - lens.cy) / lens.fy - center[1]
        normal = (x, y, depth - center[2])
        cosine = dot(normal, light.direction) / math.sqrt(dot(normal, normal))
        picture.colors[pixel] = shaded(color, cosine, light)
