"""Ragged edges: a pixel sees what is beside it, by an error it shares with its surroundings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import NOTHING_SEEN
from envs.grasp.sensors.fields import Field, Words
from envs.grasp.simulators.kernels.worlds import kernel

Codes = NDArray[np.uint16]

# Makes other 16 bits out of 16.
SCRAMBLE = np.uint16(40503)


@kernel()
def displace(
    codes: Codes,
    stride: int,
    step: int,
    limit: float,
    field: Field,
    apart: int,
    moved: Codes,
) -> None:
    """Moves pixels a step sideways and up or down, where two fields leave +-limit.

    Args:
        codes: (P,) of rows one after the other, with a step or more of columns on both sides that
            may be moved into the picture; written.
        stride: from one row to the next.
        step: in pixels.
        limit: on the fields.
        field: random numbers,
        apart: of which so far from each other two are independent: from there on they move pixels
            sideways, from twice as far on up and down.
        moved: room for at least a step of rows more, above and below.
    """
    above, size = step * stride, len(codes)
    first, last = np.uint32(above), np.uint32(size - stride + above)
    beyond, short = np.int16(limit), np.int16(-limit)
    _choose(codes, step, size - 2 * step, field, apart + step, beyond, short, moved, above + step)
    for i in range(np.uint32(above)):
        column = i % np.uint32(stride)
        moved[i] = moved[first + column]
        moved[first + np.uint32(size) + i] = moved[last + column]
    _choose(moved, above, size, field, 2 * apart, beyond, short, codes, 0)


@kernel(counts=False)
def _choose(
    source: Codes,
    step: int,
    size: int,
    field: Field,
    begin: int,
    beyond: np.int16,
    short: np.int16,
    target: Codes,
    end: int,
) -> None:
    """Of each pixel what is at it, a step ahead (field beyond a limit) or a step behind."""
    random, to = np.uint32(begin), np.uint32(end)
    middle, front = np.uint32(step), np.uint32(2 * step)
    for i in range(np.uint32(size)):
        number, behind, here, ahead = (
            field[random + i],
            source[i],
            source[middle + i],
            source[front + i],
        )
        here = ahead if number > beyond else here
        target[to + i] = behind if number < short else here


@kernel(counts=False)
def add_specks(words: Words, probability: float, codes: Codes) -> None:
    """Makes single pixels missing, by random words."""
    if probability <= 0.0:
        return
    last = np.uint16(65536.0 * min(probability, 1.0) - 1.0)
    for i in range(np.uint32(len(codes))):
        is_missing = np.uint16(words[i] * SCRAMBLE) <= last
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
