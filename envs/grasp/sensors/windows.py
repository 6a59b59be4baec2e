"""What a structured-light camera's windows match: from true depths to one picture's codes.

Disparities, and what is in the projector's shadow (`shadows`) -> noise, steps, and what is missing
beside edges or at an incidence (`surfaces`) -> holes in what is dark (`dark`) -> edges that are
moved, and specks (`edges`). Everything that is random comes from the picture's seed (`fields`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.sensors.dark import darken
from envs.grasp.sensors.edges import add_specks, copy_out, displace
from envs.grasp.sensors.fields import (
    FIELD_SIGMA,
    TOGETHER,
    Field,
    Words,
    average,
    fill_white,
    quantile,
)
from envs.grasp.sensors.matching import Limits, Matching
from envs.grasp.sensors.shadows import find_shadows, greatest, place, rows_with
from envs.grasp.sensors.surfaces import GRAZING_SIGMA_M, Errors, Lens, Losses, measure
from envs.grasp.simulators.kernels.worlds import kernel

Pixels = NDArray[np.float32]
Codes = NDArray[np.uint16]

# The mean of the positive part of a normal number.
MEAN_EXCESS = 1.0 / math.sqrt(2.0 * math.pi)
# The sigma of what is uniform within +-1/2: by so much a shadow's end is rounded.
DITHER = 1.0 / math.sqrt(12.0)
NEAREST_M = 0.4
# So far from its neighbours' line noise hardly brings a pixel.
EDGE_M = 0.03
# Shadows are looked for as far as depths may err beyond the range.
BEYOND_RANGE = 1.1


class Desk(NamedTuple):
    """Room to work on one picture (H, W), whose rows here have S = W + 2 * margin pixels.

    Attributes:
        columns, rows: (P,) of the pixels; P = H * S.
        disparity: (P + 2 * S,) true ones, with a row above and below.
        keys, hidden, other: (P + 2 * reach,) of the shadows.
        bits, words: random, the same in 32 and in 16 bits.
        white, first, second: random fields.
        codes: (P,) what comes of it.
        moved: (P + 2 * margin * S,) room.
    """

    columns: Pixels
    rows: Pixels
    disparity: Pixels
    keys: Pixels
    hidden: Pixels
    other: Pixels
    bits: NDArray[np.uint32]
    words: Words
    white: Field
    first: Field
    second: Field
    codes: Codes
    moved: Codes


@kernel()
def desk(matching: Matching) -> Desk:
    """Room to work on pictures."""
    stride = matching.width + 2 * matching.margin
    size = matching.height * stride
    columns, rows = np.empty(size, np.float32), np.empty(size, np.float32)
    for pixel in range(size):
        columns[pixel], rows[pixel] = pixel % stride - matching.margin, pixel // stride
    keys = np.empty(size + 2 * matching.reach, np.float32)
    white = _white_size(matching, size)
    bits = np.empty((white + TOGETHER - 1) // TOGETHER * 2, np.uint32)
    return Desk(
        columns,
        rows,
        np.empty(size + 2 * stride, np.float32),
        keys,
        np.empty_like(keys),
        np.empty_like(keys),
        bits,
        bits.view(np.uint16),
        np.empty(white, np.int16),
        np.empty(white, np.int16),
        np.empty(white, np.int16),
        np.empty(size, np.uint16),
        np.empty(size + 2 * matching.margin * stride, np.uint16),
    )


@kernel()
def _more_noise(matching: Matching) -> int:
    """How much longer than the picture the noise's field is, for what else is made of it.

    These are the sideways errors, which take it a window and two windows farther on, where it is
    independent, and the holes, which are averages of it.
    """
    stride = matching.width + 2 * matching.margin
    return max(2 * matching.window, (matching.blob - matching.window) * (1 + stride))


@kernel()
def _white_size(matching: Matching, size: int) -> int:
    """How many white numbers it takes to make the noise's field of them."""
    stride = matching.width + 2 * matching.margin
    return size + _more_noise(matching) + (matching.window - 1) * (1 + stride)


@kernel()
def _first_rows(desk: Desk, matching: Matching, rows: int) -> Desk:
    """The room of so many rows."""
    stride = matching.width + 2 * matching.margin
    size = rows * stride
    white = _white_size(matching, size)
    return Desk(
        desk.columns[:size],
        desk.rows[:size],
        desk.disparity[: size + 2 * stride],
        desk.keys[: size + 2 * matching.reach],
        desk.hidden[: size + 2 * matching.reach],
        desk.other[: size + 2 * matching.reach],
        desk.bits[: (white + TOGETHER - 1) // TOGETHER * 2],
        desk.words,
        desk.white[:white],
        desk.first,
        desk.second,
        desk.codes[:size],
        desk.moved[: size + 2 * matching.margin * stride],
    )


@kernel()
def match(
    true: Pixels,
    matching: Matching,
    picture: int,
    seed: np.uint64,
    limits: Limits,
    desk: Desk,
    codes: Codes,
) -> None:
    """Writes the codes (H * W,) of one picture from true inverse depths, 0 where nothing is hit.

    Args:
        true: (H * W or more,) row by row, 1/m.
        matching: of n pictures.
        picture: which of them this is.
        seed: of all that is random.
        limits: range and encoding.
        desk: room to work.
        codes: written.
    """
    width, height, margin = matching.width, matching.height, matching.margin
    strength, scale_error = matching.strength[picture], matching.scale_error[picture]
    farthest_m = limits.max_m * (BEYOND_RANGE + strength * abs(scale_error))
    first, end = rows_with(true, width, height, 1.0 / farthest_m)
    # Edges move into the rows beyond, and random numbers come so many together.
    first, end = max(first - margin, 0) // TOGETHER * TOGETHER, min(end + margin, height)
    if first < end:
        rows = _first_rows(desk, matching, end - first)
        _match_rows(true, first, matching, picture, seed, farthest_m, limits, rows)
    copy_out(desk.codes, width, height, margin, first, end, codes)


@kernel()
def _match_rows(
    true: Pixels,
    first: int,
    matching: Matching,
    picture: int,
    seed: np.uint64,
    farthest_m: float,
    limits: Limits,
    desk: Desk,
) -> None:
    """Writes the codes of the rows from the first on for which the desk has room."""
    width, margin, disparity_m = matching.width, matching.margin, matching.disparity_m
    stride, strength = width + 2 * margin, matching.strength[picture]
    size = len(desk.codes)
    fill_white(seed, first * stride, desk.bits, desk.words, desk.white)
    noise, holes = _fields(matching, size, desk)
    rows = size // stride
    nearest = disparity_m * greatest(true, first * width, rows * width)
    lower = matching.side * (nearest + 1.0)
    place(true, first, disparity_m, width, margin, lower, desk.disparity, desk.keys)
    shadow = matching.shadow * strength
    longest = shadow * (nearest - disparity_m / farthest_m)
    hidden = find_shadows(size, matching.side * shadow, longest, desk.keys, desk.hidden, desk.other)
    measure(
        desk.disparity,
        stride,
        matching.side,
        desk.keys[matching.reach :],
        hidden[matching.reach :],
        desk.columns,
        desk.rows,
        noise,
        holes,
        _lens(matching, picture, first),
        _losses(matching, picture),
        _errors(matching, picture, limits),
        desk.codes,
    )
    _darken_boxes(matching, picture, first, holes, desk)
    sigma = strength * matching.jitter
    step = min(max(math.ceil(sigma), 1), margin)
    limit = -quantile(min(MEAN_EXCESS * sigma / step, 0.5), matching.window)
    edge = max(EDGE_M * limits.codes_per_m, 1.0)
    displace(desk.codes, stride, step, limit, edge, noise, matching.window, desk.moved)
    add_specks(desk.words, strength * matching.speck + matching.missing[picture], desk.codes)


@kernel()
def _fields(matching: Matching, size: int, desk: Desk) -> tuple[Field, Field]:
    """The noise's field, and that of the holes, which are averages of it."""
    window, stride = matching.window, matching.width + 2 * matching.margin
    noise, free = average(
        desk.white, 1, window, stride, size + _more_noise(matching), desk.first, desk.white
    )
    holes, _ = average(noise, window, matching.blob, stride, size, free, desk.second)
    return noise, holes


@kernel()
def _darken_boxes(matching: Matching, picture: int, first: int, holes: Field, desk: Desk) -> None:
    camera = (
        matching.pinhole[picture, 0],
        matching.pinhole[picture, 1],
        matching.pinhole[picture, 2],
        matching.pinhole[picture, 3] - first,
    )
    stride = matching.width + 2 * matching.margin
    size = (matching.width, len(desk.codes) // stride, matching.margin)
    for box in range(matching.dark.shape[1]):
        share = min(matching.dark_missing[picture, box] * matching.strength[picture], 1.0)
        if share > 0.0:
            darken(
                desk.disparity[stride:],
                matching.disparity_m,
                camera,
                matching.dark[picture],
                box,
                quantile(share, matching.blob),
                holes,
                size,
                desk.codes,
            )


@kernel()
def _lens(matching: Matching, picture: int, first: int) -> Lens:
    """The lens of a picture of which some rows are left out before the first."""
    fx, fy = matching.pinhole[picture, 0], matching.pinhole[picture, 1]
    cx, cy = matching.pinhole[picture, 2], matching.pinhole[picture, 3] - first
    return Lens(
        np.float32(fx),
        np.float32(fy),
        np.float32(1.0 / fx),
        np.float32(1.0 / fy),
        np.float32((0.5 - cx) / fx),
        np.float32((0.5 - cy) / fy),
    )


@kernel()
def _losses(matching: Matching, picture: int) -> Losses:
    strength = matching.strength[picture]
    begins, ends = matching.cosines
    lack = quantile(min(strength * matching.lack, 1.0), matching.window)
    if strength <= 0.0:
        return Losses(
            np.float32(matching.edge),
            np.float32(lack),
            np.float32(-1.0),
            np.float32(-1.0),
            np.float32(0.0),
            np.float32(np.inf),
            np.float32(0.0),
        )
    # The share that fails grows with the cosine from 0 to `strength`, and has been drawn here as a
    # number of the mean 1/2 and the variance 1/12.
    ramp = (begins - ends) / strength
    return Losses(
        np.float32(matching.edge),
        np.float32(lack),
        np.float32(begins),
        np.float32(begins - 0.5 * ramp),
        np.float32(ramp * DITHER / FIELD_SIGMA),
        np.float32(0.5 / (matching.shadow * strength)),
        np.float32(DITHER / (strength * FIELD_SIGMA)),
    )


@kernel()
def _errors(matching: Matching, picture: int, limits: Limits) -> Errors:
    strength, disparity_m = matching.strength[picture], matching.disparity_m
    noise, step = strength / FIELD_SIGMA, strength * matching.step
    scale, offset_m = matching.scale_error[picture], matching.offset_m[picture]
    codes_per_m, zero_m = limits.codes_per_m, limits.zero_m
    # sigma_z = sigma + growth * (z - 0.4)^2, times d^2 / (f b) with z = f b / d
    growth, near = noise * matching.growth_per_m, NEAREST_M / disparity_m
    return Errors(
        np.float32(noise * matching.sigma_m / disparity_m + growth * disparity_m * near * near),
        np.float32(-2.0 * growth * disparity_m * near),
        np.float32(growth * disparity_m),
        np.float32(noise * GRAZING_SIGMA_M / disparity_m),
        np.float32(step),
        np.float32(1.0 / step if step > 0.0 else 0.0),
        np.float32(disparity_m * (1.0 + strength * scale) * codes_per_m),
        np.float32((strength * offset_m - zero_m) * codes_per_m),
        np.float32((limits.min_m - zero_m) * codes_per_m),
        np.float32((limits.max_m - zero_m) * codes_per_m),
        np.float32(limits.first),
        np.float32(limits.last),
    )
