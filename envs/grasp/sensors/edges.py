"""Ragged edges: a pixel sees what is beside it, by an error it shares with its surroundings."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import NOTHING_SEEN
from envs.grasp.sensors.fields import Field, Words
from envs.grasp.simulators.kernels.worlds import kernel

Codes = NDArray[np.uint16]

# Makes other 16 bits out of 16.
SCRAMBLE = np.uint16(40503)
WORDS = 65536


@kernel()
def displace(
    codes: Codes,
    stride: int,
    step: int,
    limit: float,
    edge: float,
    field: Field,
    apart: int,
    moved: Codes,
) -> None:
    """Moves pixels beside edges a step sideways and up or down, where two fields leave +-limit.

    Args:
        codes: (P,) of rows one after the other, with a step or more of columns on both sides that
            may be moved into the picture; written.
        stride: from one row to the next.
        step: in pixels.
        limit: on the fields.
        edge: codes by which a pixel lies out of line with both its neighbours at an edge.
        field: random numbers,
        apart: of which so far from each other two are independent: from there on they move pixels
            sideways, from twice as far on up and down.
        moved: room for at least a step of rows more, above and below.
    """
    above, size = step * stride, len(codes)
    first, last = np.uint32(above), np.uint32(size - stride + above)
    limits = (np.int16(limit), np.int16(-limit), np.uint16(edge))
    _choose(codes, step, size - 2 * step, field, apart + step, limits, moved, above + step)
    for i in range(np.uint32(above)):
        column = i % np.uint32(stride)
        moved[i] = moved[first + column]
        moved[first + np.uint32(size) + i] = moved[last + column]
    _choose(moved, above, size, field, 2 * apart, limits, codes, 0)


@kernel(counts=False)
def _choose(
    source: Codes,
    step: int,
    size: int,
    field: Field,
    begin: int,
    limits: tuple[np.int16, np.int16, np.uint16],
    target: Codes,
    end: int,
) -> None:
    """Of each pixel what is at it; at edges, a step ahead (field beyond a limit) or behind."""
    beyond, short, edge = limits
    random, to = np.uint32(begin), np.uint32(end)
    middle, front, both = np.uint32(step), np.uint32(2 * step), np.uint16(edge + edge)
    for i in range(np.uint32(size)):
        number, behind = field[random + i], source[i]
        here, ahead = source[middle + i], source[front + i]
        # Numbers under 0 are great ones, so that this is |bend| > edge.
        bend = np.uint16(behind + ahead - here - here)
        is_edge = np.uint16(bend + edge) > both
        here = ahead if is_edge & (number > beyond) else here
        target[to + i] = behind if is_edge & (number < short) else here


@kernel(counts=False)
def add_specks(words: Words, probability: float, codes: Codes) -> None:
    """Makes single pixels missing, by random words."""
    last = math.floor(WORDS * min(probability, 1.0)) - 1
    if last < 0:
        return
    most = np.uint16(last)
    for i in range(np.uint32(len(codes))):
        is_missing = np.uint16(words[i] * SCRAMBLE) <= most
        codes[i] = np.uint16(NOTHING_SEEN) if is_missing else codes[i]


@kernel(counts=False)
def copy_out(
    wide: Codes, width: int, height: int, margin: int, first: int, end: int, codes: Codes
) -> None:
    """Leaves out the margins beside the rows; before the first row and from the end on is nothing.

    Args:
        wide: rows of W + 2 * margin, from the first on.
        width: W.
        height: H.
        margin: columns.
        first: row.
        end: row.
        codes: (H * W,) written.
    """
    for row in range(height):
        is_there = np.uint16(first <= row < end)
        source = np.uint32(max(row - first, 0) * (width + 2 * margin) + margin)
        target = np.uint32(row * width)
        for column in range(np.uint32(width)):
            codes[target + column] = is_there * wide[source + column]
