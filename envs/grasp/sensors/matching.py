"""The matching of a structured-light camera, in the numbers that its kernels take.

All is done at the pixels that are sampled, in units of the sensor's pixels, so that an image costs
what it has pixels: where between two of them an edge lies is not known, and is drawn. See
`envs.grasp.sensors.windows` for how an image comes about.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.sensors.camera import CameraPoses, pinhole, sampling
from envs.grasp.sensors.fields import power_of_two
from envs.grasp.sensors.shadows import reach
from envs.grasp.sensors.structured_light import StructuredLight

Floats = NDArray[np.float64]

# The disparity jumps at an edge by so many sensor pixels, beyond the surface's own slope, and by
# more than slopes differ where two faces of a thing meet.
EDGE_PX = 1.0
CREASE = 0.25


class Matching(NamedTuple):
    """The matching of n pictures; lengths in sensor pixels are divided by the sampling's `every`.

    Attributes:
        width, height, margin: of the pictures, and columns beside them: no pixel is moved farther,
            whatever its picture's strength, as where random numbers go depends on it.
        window, blob: pixels over which noise and holes are correlated, powers of two.
        reach: see `envs.grasp.sensors.shadows.reach`.
        pinhole: (n, 4) fx, fy, cx, cy in pixels of the picture.
        strength: (n,) factor on all of the following.
        scale_error, offset_m: (n,) depth = (1 + scale_error) * true depth + offset_m.
        missing: (n,) probability of single pixels to be missing, whatever the strength.
        dark: (n, K, 4, 3) see `CameraPoses.dark`.
        dark_missing: (n, K) share of the pixels that is missing on them.
        disparity_m: focal length times baseline: disparity = this / depth.
        side: of the projector, 1: on the right, -1: on the left.
        shadow: whether it casts shadows, 1 or 0.
        step: of the disparity.
        jitter: sigma of the sideways error.
        lack: how far from an edge a window has too little of one surface.
        edge: jump of the disparity that is an edge.
        speck: probability of single pixels to be missing.
        sigma_m, growth_per_m: noise at 0.4 m, and its growth per square metre.
        cosines: of the incidences at which matches begin to fail, and at which all do.
    """

    width: int
    height: int
    margin: int
    window: int
    blob: int
    reach: int
    pinhole: Floats
    strength: Floats
    scale_error: Floats
    offset_m: Floats
    missing: Floats
    dark: Floats
    dark_missing: Floats
    disparity_m: float
    side: int
    shadow: float
    step: float
    jitter: float
    lack: float
    edge: float
    speck: float
    sigma_m: float
    growth_per_m: float
    cosines: tuple[float, float]


class Limits(NamedTuple):
    """What `DepthImage.encode` does, in numbers.

    Attributes:
        min_m, max_m: ends of the range.
        zero_m, codes_per_m: code = (depth - zero_m) * codes_per_m.
        first, last: codes of the ends.
    """

    min_m: float
    max_m: float
    zero_m: float
    codes_per_m: float
    first: int
    last: int


def matching_of(views: CameraPoses) -> Matching:
    """The matching of n structured-light cameras; of any other camera an empty one."""
    taken, settings = sampling(views.camera), views.camera.sensor
    if not isinstance(settings, StructuredLight):
        return NO_MATCHING
    every, jitter = float(taken.every), settings.jitter_px / taken.every
    begins, ends = np.cos(np.radians(settings.incidence_deg))
    return Matching(
        width=taken.width,
        height=taken.height,
        margin=max(math.ceil(jitter * settings.strength[1]), 1),
        window=power_of_two(settings.window_px / every),
        blob=power_of_two(settings.blob_px / every),
        reach=reach(taken.width),
        pinhole=np.ascontiguousarray(views.intrinsics, np.float64),
        strength=np.ascontiguousarray(views.sensor_strength, np.float64),
        scale_error=np.ascontiguousarray(views.depth_scale_error, np.float64),
        offset_m=np.ascontiguousarray(views.depth_offset_m, np.float64),
        missing=np.ascontiguousarray(views.missing_fraction, np.float64),
        dark=np.ascontiguousarray(views.dark, np.float64),
        dark_missing=np.ascontiguousarray(views.dark_missing, np.float64),
        disparity_m=pinhole(views.camera).fx * abs(settings.baseline_m),
        side=1 if settings.baseline_m > 0.0 else -1,
        shadow=float(settings.shadow),
        step=settings.disparity_step_px / every,
        jitter=jitter,
        lack=(settings.min_support - 0.5) * settings.window_px / every,
        edge=max(EDGE_PX / every, CREASE),
        speck=settings.speck_fraction,
        sigma_m=settings.axial_sigma_m,
        growth_per_m=settings.axial_growth_per_m,
        cosines=(float(begins), float(ends)),
    )


NOTHING = np.empty(0)
NO_MATCHING = Matching(
    width=0,
    height=0,
    margin=1,
    window=1,
    blob=1,
    reach=1,
    pinhole=np.empty((0, 4)),
    strength=NOTHING,
    scale_error=NOTHING,
    offset_m=NOTHING,
    missing=NOTHING,
    dark=np.empty((0, 0, 4, 3)),
    dark_missing=np.empty((0, 0)),
    disparity_m=0.0,
    side=1,
    shadow=0.0,
    step=0.0,
    jitter=0.0,
    lack=0.0,
    edge=0.0,
    speck=0.0,
    sigma_m=0.0,
    growth_per_m=0.0,
    cosines=(0.0, 0.0),
)
