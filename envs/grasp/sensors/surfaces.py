"""The codes of what a structured-light camera's windows match, before their edges are moved."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import NOTHING_SEEN
from envs.grasp.sensors.fields import Field
from envs.grasp.sensors.noise import FAST
from envs.grasp.simulators.kernels.worlds import kernel

Pixels = NDArray[np.float32]
Codes = NDArray[np.uint16]

# Nguyen et al. 2012, equation 3: beyond 60 deg of incidence sigma is greater by GRAZING_SIGMA_M
# (there over the root of the distance, about 1 m here) times (theta / (90 deg - theta))^2, which is
# a / cos^2 - b to 10 % up to 85 deg.
GRAZING_SIGMA_M = 0.0001
GRAZING = (np.float32(2.1), np.float32(4.8))


class Lens(NamedTuple):
    """Focal lengths, their inverses, and the ray of the first column and row."""

    fx: np.float32
    fy: np.float32
    per_fx: np.float32
    per_fy: np.float32
    first_x: np.float32
    first_y: np.float32


class Losses(NamedTuple):
    """When a pixel is missing.

    Attributes:
        edge: jump of the disparity that is an edge.
        lack: under which number of the noise's field a pixel beside an edge is missing.
        cosine: of the incidence at which matches begin to fail,
        middle: at which they fail where the holes' field is 0,
        spread: and what it falls by where that rises.
        slope: towards the projector, at which a pixel is hidden by the next one.
        dither: what the holes' field adds to what hides a key farther away.
    """

    edge: np.float32
    lack: np.float32
    cosine: np.float32
    middle: np.float32
    spread: np.float32
    slope: np.float32
    dither: np.float32


class Errors(NamedTuple):
    """How a disparity errs, and which code comes of it.

    Attributes:
        square, linear, constant: sigma of the noise, by powers of the disparity.
        grazing: what it grows by at an incidence.
        step: of the disparity, or 0.
        per_step: one over that, if any.
        level, zero: code = level / disparity + zero.
        low, high: ends of the range, as codes.
        first, last: codes there may be.
    """

    square: np.float32
    linear: np.float32
    constant: np.float32
    grazing: np.float32
    step: np.float32
    per_step: np.float32
    level: np.float32
    zero: np.float32
    low: np.float32
    high: np.float32
    first: np.float32
    last: np.float32


@kernel(counts=False, fastmath=FAST)
def measure(
    disparity: Pixels,
    stride: int,
    side: int,
    keys: Pixels,
    hidden: Pixels,
    columns: Pixels,
    rows: Pixels,
    noise: Field,
    holes: Field,
    lens: Lens,
    losses: Losses,
    errors: Errors,
    codes: Codes,
) -> None:
    """Writes codes (P,) with noise and in steps.

    Nothing is divided but once, and no root is taken: all is in disparities and in squares.

    Args:
        disparity: (P + 2 * stride,) true ones, with the rows above and below.
        stride: from one row to the next.
        side: of the projector, 1: on the right, -1: on the left.
        keys: (P or more,) see `envs.grasp.sensors.shadows`.
        hidden: (P or more,) keys that are in the shadow.
        columns: (P,) of the pixels.
        rows: (P,) of the pixels.
        noise: (P or more,) a random field.
        holes: (P or more,) another.
        lens: where rays go.
        losses: when a pixel is missing.
        errors: of the others.
        codes: written.
    """
    edge, lack, most, middle, spread, slope, dither = losses
    here, below, to_next = np.uint32(stride), np.uint32(2 * stride), np.uint32(stride + side)
    to_left, to_right = np.uint32(stride - 1), np.uint32(stride + 1)
    for i in range(np.uint32(len(codes))):
        d, left, right = disparity[i + here], disparity[i + to_left], disparity[i + to_right]
        up, down = disparity[i], disparity[i + below]
        forward, backward, downward, upward = right - d, d - left, down - d, d - up
        # On its own side of an edge a surface is smooth: the smaller slope is its own.
        across = forward if abs(forward) < abs(backward) else backward
        along = downward if abs(downward) < abs(upward) else upward
        jump = max(abs(forward - backward), abs(downward - upward))
        squares = _squares(d, across, along, columns[i], rows[i], lens)
        number, hole = np.float32(np.int32(noise[i])), np.float32(np.int32(holes[i]))
        fails = min(middle - spread * hole, most)
        is_missing = (jump > edge) & (number < lack)
        is_missing = is_missing | (fails * abs(fails) * squares > d * d)
        is_missing = is_missing | (disparity[i + to_next] - d > slope)
        is_missing = is_missing | (hidden[i] + dither * hole > keys[i])
        code = _code(d, squares, number, errors)
        codes[i] = np.uint16(NOTHING_SEEN) if is_missing else code


@kernel(counts=False, fastmath=FAST)
def _squares(
    d: np.float32,
    across: np.float32,
    along: np.float32,
    column: np.float32,
    row: np.float32,
    lens: Lens,
) -> np.float32:
    """d^2 over cos^2 of the incidence, of a disparity d and its slopes.

    The ray is (x, y, 1). Where d is affine in u = fx x and v = fy y, the normal over its distance,
    times f b, is (fx d_u, fy d_v, d - u d_u - v d_v), and its product with the ray is d.
    """
    fx, fy, per_fx, per_fy, first_x, first_y = lens
    x, y = per_fx * column + first_x, per_fy * row + first_y
    normal_x, normal_y = fx * across, fy * along
    normal_z = d - x * normal_x - y * normal_y
    ray = x * x + y * y + np.float32(1.0)
    return (normal_x * normal_x + normal_y * normal_y + normal_z * normal_z) * ray


@kernel(counts=False, fastmath=FAST)
def _code(d: np.float32, squares: np.float32, number: np.float32, errors: Errors) -> np.uint16:
    """The code of a disparity with noise and in steps."""
    second, linear, constant, grazing, step, per_step = errors[:6]
    level, zero, low, high, first, last = errors[6:]
    none, square = np.float32(0.0), d * d
    # sigma_d = sigma_z d^2 / (f b), where sigma_z is quadratic in z
    excess = max(GRAZING[0] * squares - GRAZING[1] * square, none)
    measured = d + (second * square + linear * d + constant + grazing * excess) * number
    measured = np.rint(measured * per_step) * step if step > none else measured
    code = level / measured + zero
    is_seen = (code >= low) & (code <= high) & (d > none)
    whole = np.int32(min(max(np.rint(code), first), last))
    return np.uint16(whole) if is_seen else np.uint16(NOTHING_SEEN)
