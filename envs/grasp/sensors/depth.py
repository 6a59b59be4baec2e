"""The depth sensor's model: from true depth to the raw image, in both simulators the same numbers.

True depth -> noise, Gaussian or of structured light -> what is outside the range or missing becomes
"nothing seen" -> encoding. What is random in a picture comes from its seed alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import NOTHING_SEEN, DepthImage
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.sensors.matching import NO_MATCHING, Limits, Matching, matching_of
from envs.grasp.sensors.noise import FAST, fill_normals, fill_uniforms
from envs.grasp.sensors.structured_light import MAX_STRENGTH
from envs.grasp.sensors.windows import Desk, desk, match
from envs.grasp.settings import MAX_NOISE_SIGMA_M
from envs.grasp.simulators.kernels.worlds import kernel

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]
Codes = NDArray[np.uint16]

MOST = {
    "noise_sigma_m": MAX_NOISE_SIGMA_M,
    "missing_fraction": 1.0,
    "sensor_strength": MAX_STRENGTH,
}


class Sensor(NamedTuple):
    """The depth sensor of n pictures.

    Attributes:
        seeds: (n,) uint64 of all that is random in each picture.
        sigma_m: (n,) of the noise.
        missing: (n,) probability of each pixel to be missing.
        limits: range and encoding.
        matching: of a structured-light camera, or none.
    """

    seeds: NDArray[np.uint64]
    sigma_m: Floats
    missing: Floats
    limits: Limits
    matching: Matching


NO_LIMITS = Limits(0.0, 0.0, 0.0, 0.0, 0, 0)
NO_SENSOR = Sensor(np.empty(0, np.uint64), np.empty(0), np.empty(0), NO_LIMITS, NO_MATCHING)


class Workbench(NamedTuple):
    """Room to work on one picture of P pixels.

    Attributes:
        normals, uniforms: (P or P + 1,) random numbers.
        desk: of a structured-light camera.
    """

    normals: Pixels
    uniforms: Pixels
    desk: Desk


def sensor_of(views: CameraPoses, space: DepthImage, seeds: NDArray[np.uint64]) -> Sensor:
    """The sensor of n depth cameras whose raw images belong to a space.

    Args:
        views: the cameras.
        space: range and encoding.
        seeds: (n,) of the pictures.

    Raises:
        ValueError: a camera's noise, share of missing pixels or strength of faults is not of shape
            (n,), or not within what the settings allow.
    """
    for name, most in MOST.items():
        values = np.asarray(getattr(views, name))
        if values.shape != np.shape(seeds) or not ((values >= 0.0) & (values <= most)).all():
            raise ValueError(
                f"{name} must be within 0 and {most:g}, one for each of {len(seeds)} pictures"
            )
    return Sensor(
        np.ascontiguousarray(seeds, np.uint64),
        np.ascontiguousarray(views.noise_sigma_m, np.float64),
        np.ascontiguousarray(views.missing_fraction, np.float64),
        Limits(*space.range_m, space.zero_m, space.codes_per_m, *space.codes),
        matching_of(views),
    )


def sense_depth(
    depth_m: Pixels, views: CameraPoses, space: DepthImage, seeds: NDArray[np.uint64]
) -> NDArray[Any]:
    """Raw images (n, H, W, 1), in the space's type, of true depths.

    Args:
        depth_m: (n, H, W), infinite where nothing is hit.
        views: the cameras, with their noise.
        space: range and encoding.
        seeds: (n,) of all that is random, one for each picture, so that it does not matter which
            process takes the picture, or when.
    """
    codes = np.empty(depth_m.shape, np.uint16)
    rows = np.ascontiguousarray(depth_m, np.float32).reshape(len(depth_m), -1)
    _sense_rows(rows, sensor_of(views, space, seeds), codes.reshape(rows.shape))
    return codes[..., None].astype(space.dtype, copy=False)


@kernel()
def _sense_rows(depths: Pixels, sensor: Sensor, codes: Codes) -> None:
    bench = workbench(sensor, depths.shape[1])
    for row in range(len(depths)):
        sense(depths[row], False, sensor, row, bench, codes[row])


@kernel()
def workbench(sensor: Sensor, pixels: int) -> Workbench:
    """Room to work on one picture, for `sense`."""
    even = (pixels + 1) // 2 * 2
    return Workbench(np.zeros(even, np.float32), np.zeros(even, np.float32), desk(sensor.matching))


@kernel()
def sense(
    true: Pixels, inverse: bool, sensor: Sensor, row: int, bench: Workbench, codes: Codes
) -> None:
    """Writes the codes (P,) of one picture.

    Args:
        true: (P or more,) true depth in metres, infinite where nothing is hit; or one over it.
        inverse: which of the two. A renderer has the inverse.
        sensor: of n pictures.
        row: which of them this is.
        bench: room to work.
        codes: (P,) written.
    """
    if len(sensor.matching.strength) == 0:
        _sense_gaussian(true, inverse, sensor, row, bench.normals, bench.uniforms, codes)
        return
    if not inverse:
        for pixel in range(len(codes)):
            bench.normals[pixel] = np.float32(1.0) / true[pixel]
        true = bench.normals
    match(true, sensor.matching, row, sensor.seeds[row], sensor.limits, bench.desk, codes)


@kernel(fastmath=FAST)
def _sense_gaussian(
    true: Pixels,
    inverse: bool,
    sensor: Sensor,
    row: int,
    normals: Pixels,
    uniforms: Pixels,
    codes: Codes,
) -> None:
    """As `sense`, with white noise alone; without noise, the codes of `DepthImage.encode`."""
    if sensor.sigma_m[row] > 0.0:
        fill_normals(sensor.seeds[row], normals)
    # Where it is 0, it multiplies what an earlier picture left in the scratch.
    sigma, limits = np.float32(sensor.sigma_m[row]), sensor.limits
    low, high = np.float32(limits.min_m), np.float32(limits.max_m)
    zero, scale = np.float32(limits.zero_m), np.float32(limits.codes_per_m)
    first, last = np.float32(limits.first), np.float32(limits.last)
    for pixel in range(len(codes)):
        depth = np.float32(1.0) / true[pixel] if inverse else true[pixel]
        measured = depth + sigma * normals[pixel]
        code = np.int32(min(max(np.rint((measured - zero) * scale), first), last))
        codes[pixel] = code if (measured >= low) & (measured <= high) else NOTHING_SEEN
    missing = np.float32(sensor.missing[row])
    if missing > 0.0:
        fill_uniforms(sensor.seeds[row], uniforms)
        for pixel in range(len(codes)):
            codes[pixel] = NOTHING_SEEN if uniforms[pixel] < missing else codes[pixel]
