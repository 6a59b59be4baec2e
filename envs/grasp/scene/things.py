"""Things that are no blocks: no box, L or U of their sizes. Each is made of three boxes at most."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled
from envs.grasp.scene.boxes import Boxes, put
from envs.grasp.threefry import uniform

Floats = NDArray[np.float64]
Stream = NDArray[np.uint64]

THING_BOXES = 3
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


@compiled()
def draw_thing(
    stream: Stream, kinds: NDArray[np.int64], block_size_m: Floats, boxes: Boxes
) -> None:
    """Draws a thing of one of some kinds, that stands at the origin.

    Args:
        stream: see `threefry.uniform`.
        kinds: codes of the kinds.
        block_size_m: (2,) range of the sides of the blocks' faces.
        boxes: written, `THING_BOXES`, all of them zero before.
    """
    kind = kinds[int(uniform(stream, 0.0, len(kinds)))]
    if kind in (T, CROSS):
        _draw_beams(stream, block_size_m, boxes, kind)
    elif kind == COLUMN:
        _draw_column(stream, block_size_m, boxes)
    elif kind == TILTED:
        _draw_tilted(stream, boxes)
    else:
        _draw_box(stream, block_size_m, boxes, kind)


@compiled()
def _draw_beams(stream: Stream, block_size_m: Floats, boxes: Boxes, kind: int) -> None:
    """A T, upright or on its head, or a cross: a thin upright and a beam across its middle line."""
    low, high = block_size_m
    width, height = uniform(stream, low, high) / 2, uniform(stream, low, high) / 2
    depth, thick = uniform(stream, 0.015, 0.05), low * uniform(stream, 0.1, 0.15)
    across = 2 * height - thick if uniform(stream, 0.0, 1.0) < 0.5 else thick
    if kind == CROSS:
        across = 2 * height * uniform(stream, 0.4, 0.6)
    put(boxes, 0, (0.0, 0.0, height), (depth, thick, height), 0.0, 0.0)
    put(boxes, 1, (0.0, 0.0, across), (depth, width, thick), 0.0, 0.0)


@compiled()
def _draw_column(stream: Stream, block_size_m: Floats, boxes: Boxes) -> None:
    """A hexagonal column: three boxes about one axis, each with two opposite sides of it."""
    inner = SMALL_SHARE * block_size_m[0] * uniform(stream, 0.4, 0.8)
    height = uniform(stream, 0.03, TALLEST_M / 2 - 0.05)
    for box in range(3):
        half = (inner, inner * math.tan(math.pi / 6), height)
        put(boxes, box, (0.0, 0.0, height), half, box * math.pi / 3, 0.0)


@compiled()
def _draw_tilted(stream: Stream, boxes: Boxes) -> None:
    """A box on one of its edges: no face of it is upright, but for the ends."""
    depth, height = uniform(stream, 0.02, 0.05), uniform(stream, 0.04, 0.08)
    width, pitch = uniform(stream, 0.03, 0.12), math.radians(uniform(stream, 20.0, 45.0))
    up = height * math.cos(pitch) + depth * math.sin(pitch)
    put(boxes, 0, (0.0, 0.0, up), (depth, width, height), 0.0, pitch)


@compiled()
def _draw_box(stream: Stream, block_size_m: Floats, boxes: Boxes, kind: int) -> None:
    """A plate, a post, a cube or a slab: upright boxes, all of whose faces have a small side."""
    low, high = block_size_m
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
    put(boxes, 0, (0.0, 0.0, height), (depth, width, height), 0.0, 0.0)
