"""What a structured-light camera measures, pixel by pixel; its faults are `StructuredLight`'s.

All is done at the pixels that are sampled, in units of the sensor's pixels, so that an image costs
what it has pixels: where between two of them an edge lies is not known, and is drawn. Everything
that is random comes from the picture's seed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import NOTHING_SEEN
from envs.grasp.sensors.camera import CameraPoses, pinhole, sampling
from envs.grasp.sensors.noise import FAST, fill_bits
from envs.grasp.sensors.structured_light import StructuredLight
from envs.grasp.simulators.kernels.worlds import kernel

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]
Bits = NDArray[np.uint32]
Codes = NDArray[np.uint16]

# A jump of the disparity by so many sensor pixels, beyond the surface's own slope, is an edge.
EDGE_PX = 1.0
# Half a normal distribution's mean: how far a sideways error of sigma 1 reaches beyond an edge.
HALF_NORMAL_MEAN = 0.4
# Nguyen et al. 2012, equation 3: the growth of sigma with the angle of incidence beyond 60 deg,
# there over the root of the distance, which is about 1 m here.
INCIDENCE_SIGMA = np.float32(0.0001)
NEAREST_M = np.float32(0.4)
# Of the sum of two random bytes.
BYTES_MEAN, BYTES_SIGMA = np.float32(255.0), np.float32(math.sqrt((256.0**2 - 1.0) / 6.0))
# Makes another number of 16 random bits out of them.
SCRAMBLE = np.uint32(40503)


class Matching(NamedTuple):
    """The matching of n pictures; lengths in sensor pixels are divided by `every`.

    Attributes:
        width, height: of the pictures.
        pinhole: (n, 4) fx, fy, cx, cy in pixels of the picture.
        disparity_m: focal length times baseline, in picture pixels: disparity = this / depth.
        shadow_m: (n,) the same with the baseline of the shadows, its sign that of the baseline.
        step: (n,) step of the disparity.
        strength: (n,) of the noise and of what is missing.
        noise: sigma at 0.4 m, and its growth per square metre.
        flip: (n,) how far from an edge a pixel may see the other side.
        lack: (n,) how far beyond that a window has too little of one surface.
        cosines: of the incidences at which matches begin to fail, and at which all do.
        speck: (n,) probability of single pixels to be missing.
        scale, offset_m: (n,) depth = scale * true depth + offset.
        window, blob: pixels over which noise and holes are correlated, powers of two.
        edge: jump of the disparity that is an edge.
        dark: (n, K, 4, 3) in camera axes: centre of each dark box, and its axes over its half
            extents.
        dark_missing: (n, K) share of the pixels that is missing on them.
    """

    width: int
    height: int
    pinhole: Floats
    disparity_m: float
    shadow_m: Floats
    step: Floats
    strength: Floats
    noise: tuple[float, float]
    flip: Floats
    lack: Floats
    cosines: tuple[float, float]
    speck: Floats
    scale: Floats
    offset_m: Floats
    window: int
    blob: int
    edge: float
    dark: Floats
    dark_missing: Floats


class Limits(NamedTuple):
    """Range and encoding of depths; see `envs.grasp.sensors.depth.Sensor`."""

    min_m: float
    max_m: float
    zero_m: float
    codes_per_m: float
    first: int
    last: int


class Desk(NamedTuple):
    """Room to work on one picture (H, W), whose rows here have S = W + 2 pixels.

    The first and the last pixel of a row, and a row above and below all, repeat what is beside
    them, so that all pixels have neighbours. Arrays (P,) have P = H * S pixels, or one more.

    Attributes:
        columns, rows: (P,) of the pixels.
        disparity: ((H + 2) * S,) true ones.
        lit, other: (P,) the greatest disparity that is in the shadow of something else.
        bits: (P,) random.
        noise, holes, spare: (P,) random fields.
        codes: (P,) what comes of it.
    """

    columns: Pixels
    rows: Pixels
    disparity: Pixels
    lit: Pixels
    other: Pixels
    bits: Bits
    noise: Pixels
    holes: Pixels
    spare: Pixels
    codes: Codes


def matching_of(views: CameraPoses) -> Matching:
    """The matching of n structured-light cameras; of any other camera an empty one."""
    taken, settings = sampling(views.camera), views.camera.sensor
    if not isinstance(settings, StructuredLight):
        return NO_MATCHING
    every, strength = float(taken.every), np.ascontiguousarray(views.sensor_strength)
    disparity_m = pinhole(views.camera).fx * abs(settings.baseline_m)
    lack_px = (settings.min_support - 0.5) * settings.window_px
    return Matching(
        taken.width,
        taken.height,
        np.ascontiguousarray(views.intrinsics),
        disparity_m,
        strength * math.copysign(disparity_m, settings.baseline_m),
        strength * (settings.disparity_step_px / every),
        strength,
        (settings.axial_sigma_m, settings.axial_growth_per_m),
        strength * (HALF_NORMAL_MEAN * settings.jitter_px / every),
        strength * (lack_px / every),
        (
            math.cos(math.radians(settings.incidence_deg[0])),
            math.cos(math.radians(settings.incidence_deg[1])),
        ),
        np.minimum(strength * settings.speck_fraction + views.missing_fraction, 1.0),
        1.0 + strength * views.depth_scale_error,
        strength * views.depth_offset_m,
        _power_of_two(settings.window_px / 2.0 / every),
        _power_of_two(settings.blob_px / every),
        EDGE_PX / every,
        *_dark_in_camera_axes(views),
    )


NOTHING = np.empty(0)
NO_MATCHING = Matching(
    width=0,
    height=0,
    pinhole=np.empty((0, 4)),
    disparity_m=0.0,
    shadow_m=NOTHING,
    step=NOTHING,
    strength=NOTHING,
    noise=(0.0, 0.0),
    flip=NOTHING,
    lack=NOTHING,
    cosines=(0.0, 0.0),
    speck=NOTHING,
    scale=NOTHING,
    offset_m=NOTHING,
    window=1,
    blob=1,
    edge=1.0,
    dark=np.empty((0, 0, 4, 3)),
    dark_missing=np.empty((0, 0)),
)


def _power_of_two(pixels: float) -> int:
    """The power of two that is nearest in proportion, 1 at least."""
    return 1 << max(round(math.log2(max(pixels, 1.0))), 0)


def _dark_in_camera_axes(views: CameraPoses) -> tuple[Floats, Floats]:
    centers = (views.dark[:, :, :1] - views.position_m[:, None, None]) @ views.rotation[:, None]
    axes = views.dark[:, :, 1:] @ views.rotation[:, None]
    return np.concatenate([centers, axes], axis=2), np.ascontiguousarray(views.dark_missing)


@kernel()
def desk(matching: Matching) -> Desk:
    """Room to work on pictures."""
    stride = matching.width + 2
    pixels = (matching.height * stride + 1) // 2 * 2
    columns, rows = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    for pixel in range(pixels):
        columns[pixel], rows[pixel] = pixel % stride - 1, pixel // stride
    return Desk(
        columns,
        rows,
        np.empty((matching.height + 2) * stride, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.uint32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.uint16),
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
    width, height, stride = matching.width, matching.height, matching.width + 2
    fill_bits(seed, desk.bits)
    noise, holes = _fields(matching.window, matching.blob, stride, desk)
    nearest = _place(true, matching.disparity_m, width, height, desk.disparity)
    shadow = matching.shadow_m[picture] / matching.disparity_m
    lit = desk.lit
    if shadow != 0.0:
        longest = min(nearest, matching.disparity_m / limits.min_m) * abs(shadow)
        lit = _find_shadows(width, height, shadow, longest, desk)
    else:
        lit[:] = np.float32(0.0)
    _measure(
        desk.disparity,
        stride,
        lit,
        (desk.bits, noise, holes),
        (desk.columns, desk.rows),
        _camera(matching, picture),
        _chances(matching, picture),
        _errors(matching, picture),
        limits,
        desk.codes,
    )
    _copy_out(desk.codes, width, height, codes)
    for box in range(matching.dark.shape[1]):
        if matching.dark_missing[picture, box] > 0.0:
            _darken(true, matching, picture, box, holes, codes)


@kernel()
def _fields(window: int, blob: int, stride: int, desk: Desk) -> tuple[Pixels, Pixels]:
    """Two random fields (P,) of variance 1 from the upper halves of the bits: noise, and holes.

    White noise is averaged over boxes of a power of two pixels; holes are averages of the noise.
    """
    noise, spare, side = desk.noise, desk.spare, 1
    _to_noise(desk.bits, noise)
    while side < window:
        _average(noise, side, stride, spare)
        noise, spare, side = spare, noise, 2 * side
    holes, other = noise, desk.holes
    while side < blob:
        _average(holes, side, stride, spare)
        holes, spare, other, side = spare, other, spare, 2 * side
    return noise, holes


@kernel(counts=False, fastmath=FAST)
def _to_noise(bits: Bits, noise: Pixels) -> None:
    """Numbers of mean 0 and variance 1: the sums of two bytes."""
    byte, scale = np.uint32(255), np.float32(1.0) / BYTES_SIGMA
    for i in range(len(noise)):
        total = ((bits[i] >> np.uint32(16)) & byte) + (bits[i] >> np.uint32(24))
        noise[i] = (np.float32(np.int32(total)) - BYTES_MEAN) * scale


@kernel(counts=False, fastmath=FAST)
def _average(source: Pixels, side: int, stride: int, target: Pixels) -> None:
    """Boxes of twice the side from boxes of a side; what is beyond the end comes from the start."""
    half, right, below = np.float32(0.5), np.uint32(side), np.uint32(side * stride)
    both, size = np.uint32(side + side * stride), len(target)
    end = np.uint32(max(size - side - side * stride, 0))
    for i in range(end):
        target[i] = half * (source[i] + source[i + right] + source[i + below] + source[i + both])
    for i in range(end, size):
        others = source[(i + right) % size] + source[(i + below) % size] + source[(i + both) % size]
        target[i] = half * (source[i] + others)


@kernel(counts=False, fastmath=FAST)
def _place(true: Pixels, disparity_m: float, width: int, height: int, disparity: Pixels) -> float:
    """Puts disparities into rows with two more pixels, and adds a row above and below.

    Returns:
        The greatest of them.
    """
    scale, stride, most = np.float32(disparity_m), width + 2, np.float32(0.0)
    for row in range(-1, height + 1):
        source, target = min(max(row, 0), height - 1) * width, (row + 1) * stride
        begin, end = np.uint32(source), np.uint32(target + 1)
        for column in range(np.uint32(width)):
            value = scale * true[begin + column]
            disparity[end + column] = value
            most = value if value > most else most
        disparity[target] = disparity[target + 1]
        disparity[target + stride - 1] = disparity[target + stride - 2]
    return float(most)


@kernel()
def _find_shadows(width: int, height: int, shadow: float, longest: float, desk: Desk) -> Pixels:
    """Greatest disparities (P,) that are in the shadow of what stands on the projector's side.

    The projector sees the point of column u in its own column u - d (or u + d, if it is on the
    left), so that a point u' on its side hides it if d' - d > |u' - u|: the greatest d' - |u' - u|
    is found in steps of 1, 2, 4, ... columns. The edge of what hides lies half a column before u'
    on average.

    Args:
        width: W.
        height: H.
        shadow: factor on the disparity; less than 0: the projector is on the left.
        longest: the longest that a shadow can be.
        desk: with the disparities.
    """
    side, way = (1 if shadow >= 0.0 else -1), 1.0 / abs(shadow)
    source, target = desk.other, desk.lit
    _shift_in(
        desk.disparity[width + 2 :], width, height, side, np.float32(0.5 * way), False, target
    )
    reach = 1
    while reach < longest and reach < width:
        source, target = target, source
        _shift_in(source, width, height, side * reach, np.float32(reach * way), True, target)
        reach *= 2
    return target


@kernel(counts=False, fastmath=FAST)
def _shift_in(
    source: Pixels,
    width: int,
    height: int,
    shift: int,
    way: np.float32,
    keeps: bool,
    target: Pixels,
) -> None:
    """Pixels some columns farther on, less a way; or the pixels themselves, if that keeps more."""
    count, none = np.uint32(width - abs(shift)), np.float32(0.0)
    kept = np.float32(1.0) if keeps else none
    for row in range(height):
        start = row * (width + 2) + 1
        first = start + max(-shift, 0)
        here, there = np.uint32(first), np.uint32(first + shift)
        for column in range(count):
            farther, own = source[there + column] - way, kept * source[here + column]
            target[here + column] = farther if farther > own else own
        rest = np.uint32(start if shift < 0 else start + width - shift)
        for column in range(np.uint32(abs(shift))):
            target[rest + column] = kept * source[rest + column]


@kernel()
def _camera(matching: Matching, picture: int) -> tuple[np.float32, ...]:
    """fx, fy, and where the first pixel is from the optical axis."""
    pinhole = matching.pinhole
    return (
        np.float32(pinhole[picture, 0]),
        np.float32(pinhole[picture, 1]),
        np.float32(0.5 - pinhole[picture, 2]),
        np.float32(0.5 - pinhole[picture, 3]),
    )


@kernel()
def _chances(matching: Matching, picture: int) -> tuple[np.float32, ...]:
    """When a pixel is missing: jump of an edge, bytes of distance from it, cosines, specks."""
    first, last = matching.cosines
    flip = matching.flip[picture]
    return (
        np.float32(matching.edge),
        np.float32(256.0 * flip),
        np.float32(256.0 * (flip + matching.lack[picture])),
        np.float32(first),
        np.float32(matching.strength[picture] / max(first - last, 1e-6)),
        np.float32(65536.0 * matching.speck[picture]),
    )


@kernel()
def _errors(matching: Matching, picture: int) -> tuple[np.float32, ...]:
    """How a depth errs: f b, step, strength, sigma at 0.4 m, its growth, scale and offset."""
    return (
        np.float32(matching.disparity_m),
        np.float32(matching.step[picture]),
        np.float32(matching.strength[picture]),
        np.float32(matching.noise[0]),
        np.float32(matching.noise[1]),
        np.float32(matching.scale[picture]),
        np.float32(matching.offset_m[picture]),
    )


@kernel(counts=False, fastmath=FAST)
def _mass(x: np.float32) -> np.float32:
    """The share of a normal distribution below x, to 0.03."""
    x = min(max(x, np.float32(-2.0)), np.float32(2.0))
    return np.float32(0.5) + x * (np.float32(0.386) - np.float32(0.034) * x * x)


@kernel(fastmath=FAST)
def _measure(
    disparity: Pixels,
    stride: int,
    lit: Pixels,
    random: tuple[Bits, Pixels, Pixels],
    places: tuple[Pixels, Pixels],
    camera: tuple[np.float32, ...],
    chances: tuple[np.float32, ...],
    errors: tuple[np.float32, ...],
    limits: Limits,
    codes: Codes,
) -> None:
    """Writes the codes (P,) of what is matched, with its noise and in its steps.

    Args:
        disparity: (P + 2 * stride,) true ones, with the rows above and below.
        stride: from one row to the next.
        lit: what must be exceeded not to be in the shadow.
        random: bits, noise and holes (P,).
        places: columns and rows (P,).
        camera: see `_camera`.
        chances: see `_chances`.
        errors: see `_errors`.
        limits: range and encoding.
        codes: written.
    """
    (bits, noise, holes), (columns, rows) = random, places
    fx, fy, first_x, first_y = camera
    edge, flip, lack, oblique, fails, speck = chances
    disparity_m, step, strength, base, growth, scale, offset_m = errors
    one, none, byte = np.float32(1.0), np.float32(0.0), np.uint32(255)
    per_x, per_y, per_metre = one / (fx * fx), one / (fy * fy), one / disparity_m
    steps = step > none
    per_step, scaled_m = one / (step if steps else one), disparity_m * scale
    low, high = np.float32(limits.min_m), np.float32(limits.max_m)
    zero, codes_per_m = np.float32(limits.zero_m), np.float32(limits.codes_per_m)
    first, last = np.float32(limits.first), np.float32(limits.last)
    to_here, to_below = np.uint32(stride), np.uint32(2 * stride)
    to_left, to_right = np.uint32(stride - 1), np.uint32(stride + 1)
    for i in range(np.uint32(len(disparity) - 2 * stride)):
        d, left, right = disparity[i + to_here], disparity[i + to_left], disparity[i + to_right]
        above, below, word = disparity[i], disparity[i + to_below], bits[i]
        forward, backward, downward, upward = right - d, d - left, below - d, d - above
        # On its own side of an edge a surface is smooth: the smaller slope is its own.
        across = forward if abs(forward) < abs(backward) else backward
        down = downward if abs(downward) < abs(upward) else upward
        on_right, on_bottom = abs(forward - across) > edge, abs(downward - down) > edge
        by_side = on_right | (abs(backward - across) > edge)
        by_end = on_bottom | (abs(upward - down) > edge)
        # How far the edge is: some part of a pixel.
        to_side = np.float32(np.int32(word & byte))
        to_end = np.float32(np.int32((word >> np.uint32(8)) & byte))
        is_missing = (by_side & (to_side < lack)) | (by_end & (to_end < lack))
        beyond = by_side & (to_side < flip)
        seen = (right if on_right else left) if beyond else d
        is_missing = is_missing & ~beyond
        # The normal over its distance, times f b: (fx d_u, fy d_v, d - u d_u - v d_v).
        x, y = columns[i] + first_x, rows[i] + first_y
        normal_x, normal_y, normal_z = fx * across, fy * down, d - x * across - y * down
        squared = normal_x * normal_x + normal_y * normal_y + normal_z * normal_z
        # tangent^2 + 1 of the angle of incidence, whose cosine is n . ray over both lengths.
        secant = np.sqrt(squared * (x * x * per_x + y * y * per_y + one)) / d
        rare = np.float32(np.int32(((word >> np.uint32(16)) * SCRAMBLE) & np.uint32(65535)))
        is_missing = is_missing | (rare < speck) | (lit[i] > d)
        is_missing = is_missing | (_mass(holes[i]) < (oblique - one / secant) * fails)
        z = disparity_m / seen
        beyond_m = z - NEAREST_M
        # theta over what lacks to a right angle
        grazing = np.float32(math.pi / 2.0) * secant - one
        sigma = base + growth * beyond_m * beyond_m
        sigma = sigma + (INCIDENCE_SIGMA * grazing * grazing if secant > np.float32(2.0) else none)
        measured = seen + strength * sigma * noise[i] * per_metre * seen * seen
        measured = np.rint(measured * per_step) * step if steps else measured
        depth = scaled_m / measured + offset_m
        is_seen = (depth >= low) & (depth <= high) & (measured > none) & (seen > none)
        code = np.int32(min(max(np.rint((depth - zero) * codes_per_m), first), last))
        codes[i] = code if is_seen & (not is_missing) else NOTHING_SEEN


@kernel(counts=False)
def _copy_out(wide: Codes, width: int, height: int, codes: Codes) -> None:
    """Leaves out the two pixels more of each row."""
    for row in range(height):
        source, target = np.uint32(row * (width + 2) + 1), np.uint32(row * width)
        for column in range(np.uint32(width)):
            codes[target + column] = wide[source + column]


@kernel()
def _darken(
    true: Pixels, matching: Matching, picture: int, box: int, holes: Pixels, codes: Codes
) -> None:
    """Makes holes in what lies in a dark box."""
    width, fx, fy, cx, cy = (
        matching.width,
        matching.pinhole[picture, 0],
        matching.pinhole[picture, 1],
        matching.pinhole[picture, 2],
        matching.pinhole[picture, 3],
    )
    center, axes = matching.dark[picture, box, 0], matching.dark[picture, box, 1:]
    share = min(matching.dark_missing[picture, box] * matching.strength[picture], 1.0)
    # Along each axis a point lies at z * (slope * column + start) - middle, in half extents.
    slopes, middles, starts = axes[:, 0] / fx, np.empty(3), np.empty(3)
    for axis in range(3):
        middles[axis] = (
            axes[axis, 0] * center[0] + axes[axis, 1] * center[1] + axes[axis, 2] * center[2]
        )
    for row in range(matching.height):
        y = (row + 0.5 - cy) / fy
        starts[:] = slopes * (0.5 - cx) + axes[:, 1] * y + axes[:, 2]
        _darken_row(
            true[row * width : (row + 1) * width],
            holes[row * (width + 2) + 1 :],
            codes[row * width : (row + 1) * width],
            (slopes, starts, middles),
            np.float32(share),
        )


@kernel(fastmath=FAST)
def _darken_row(
    true: Pixels,
    holes: Pixels,
    codes: Codes,
    box: tuple[Floats, Floats, Floats],
    share: np.float32,
) -> None:
    slopes, starts, middles = box
    ax, ay, az = np.float32(slopes[0]), np.float32(slopes[1]), np.float32(slopes[2])
    bx, by, bz = np.float32(starts[0]), np.float32(starts[1]), np.float32(starts[2])
    cx, cy, cz = np.float32(middles[0]), np.float32(middles[1]), np.float32(middles[2])
    for i in range(len(codes)):
        column, inverse = np.float32(np.int32(i)), true[i]
        # Times the inverse depth, so that nothing is divided.
        x = abs(ax * column + bx - cx * inverse)
        y = abs(ay * column + by - cy * inverse)
        z = abs(az * column + bz - cz * inverse)
        is_missing = (x <= inverse) & (y <= inverse) & (z <= inverse) & (_mass(holes[i]) < share)
        codes[i] = NOTHING_SEEN if is_missing else codes[i]
