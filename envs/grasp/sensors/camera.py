"""The pinhole camera: which of its sensor's pixels are seen, and where it stands.

Camera axes are OpenCV's: x to the right, y down, z forward; depth is measured along z. Pixel
(column c, row r) looks along the ray through its centre, (c + 0.5, r + 0.5) from the top left.
A sampled image is the image of a pinhole camera with fewer pixels, and is rendered as such.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from encoders.cameras import Pinhole, Sampling
from encoders.spaces import DepthImage, RgbImage
from envs.cameras import euler_rotations, look_at
from envs.grasp.batch import Batch
from envs.grasp.sensors.structured_light import StructuredLight
from envs.grasp.settings import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CameraPoses(Batch):
    """Poses of n cameras of one kind.

    Attributes:
        camera: what they have in common.
        position_m: (n, 3) optical centres, world frame.
        rotation: (n, 3, 3) whose columns are the camera's axes in the world frame.
        intrinsics: (n, 4) fx, fy, cx, cy in pixels of the image as it is sampled.
        near_m, far_m: (n,) clip planes.
        noise_sigma_m: (n,) sigma of a depth camera's noise.
        missing_fraction: (n,) probability that a depth camera misses a pixel.
        sensor_strength: (n,) factor on a structured-light camera's faults.
        depth_scale_error: (n,) its depths' relative error.
        depth_offset_m: (n,) its depths' common error.
        dark: (n, K, 4, 3) boxes that hold dark or shiny surfaces, in camera axes: the centre, and
            three axes over the half extents.
        dark_missing: (n, K) share of the pixels that it misses on each.
    """

    camera: Camera
    position_m: Floats
    rotation: Floats
    intrinsics: Floats
    near_m: Floats
    far_m: Floats
    noise_sigma_m: Floats
    missing_fraction: Floats
    sensor_strength: Floats
    depth_scale_error: Floats
    depth_offset_m: Floats
    dark: Floats
    dark_missing: Floats


# Outside, with the whole robot and the support in view, and before a wall behind them.
OVERVIEW = Camera(
    type="rgb",
    width=640,
    height=480,
    fov_deg=56.0,
    position_m=(1.1, -2.2, 1.7),
    target_m=(0.8, 0.0, 0.85),
    near_m=(0.1, 0.1),
    far_m=(10.0, 10.0),
)


def sensor_pinhole(camera: Camera) -> Pinhole:
    """The camera in pixels of its sensor."""
    if camera.intrinsics is not None:
        return Pinhole(**camera.intrinsics.model_dump())
    across, down = camera.fov_deg if isinstance(camera.fov_deg, tuple) else (camera.fov_deg, None)
    fx = _focal_length_px(camera.width, across)
    fy = fx if down is None else _focal_length_px(camera.height, down)
    return Pinhole(fx, fy, camera.width / 2.0, camera.height / 2.0)


def sampling(camera: Camera) -> Sampling:
    """Which of the sensor's pixels are in the image."""
    return camera.sampling.of_sensor(camera.width, camera.height)


def pinhole(camera: Camera) -> Pinhole:
    """The camera in pixels of the image as it is sampled."""
    return sampling(camera).pinhole(sensor_pinhole(camera))


def image_space(camera: Camera) -> DepthImage | RgbImage:
    """The images that a camera's sensor delivers."""
    taken = sampling(camera)
    if camera.type == "rgb":
        return RgbImage(taken.height, taken.width, taken)
    return DepthImage(
        taken.height, taken.width, camera.range_m, camera.encoding, pinhole(camera), taken
    )


def nominal_pose(camera: Camera) -> tuple[Floats, Floats]:
    """Where a camera stands when nothing is drawn: its centre (3,) and axes (3, 3) as columns."""
    position_m = np.array(camera.position_m)
    roll_rad = float(np.radians(camera.roll_deg))
    return position_m, look_at(position_m, np.array(camera.target_m), roll_rad)


def _focal_length_px(pixels: int, fov_deg: float) -> float:
    return pixels / 2.0 / float(np.tan(np.radians(fov_deg) / 2.0))


def sample_views(
    camera: Camera, rng: np.random.Generator, n: int, position_m: float, rotation_deg: float
) -> CameraPoses:
    """Places n cameras, moved by up to +-`position_m` and turned by `rotation_deg` per axis.

    A structured-light camera's faults are drawn, too; nothing in view is dark.
    """
    nominal, nominal_rotation = nominal_pose(camera)
    jitter = np.radians(rng.uniform(-rotation_deg, rotation_deg, (n, 3)))
    views = CameraPoses(
        camera,
        nominal + rng.uniform(-position_m, position_m, (n, 3)),
        nominal_rotation @ euler_rotations(jitter),
        np.tile(astuple(pinhole(camera)), (n, 1)),
        rng.uniform(*camera.near_m, n),
        rng.uniform(*camera.far_m, n),
        np.full(n, camera.noise_sigma_m),
        rng.uniform(*camera.missing_fraction, n),
        np.ones(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros((n, 0, 4, 3)),
        np.zeros((n, 0)),
    )
    sensor = camera.sensor
    return _with_faults(views, sensor, rng) if isinstance(sensor, StructuredLight) else views


def _with_faults(
    views: CameraPoses, sensor: StructuredLight, rng: np.random.Generator
) -> CameraPoses:
    """The same cameras with a structured-light camera's errors of calibration."""
    n, taken = len(views), sampling(views.camera)
    strength = rng.uniform(*sensor.strength, n)
    focal = 1.0 + strength * rng.uniform(-sensor.focal_scale, sensor.focal_scale, n)
    sides_px = np.array([taken.sensor_width, taken.sensor_height]) / taken.every
    center_px = rng.uniform(-sensor.center_fraction, sensor.center_fraction, (n, 2)) * sides_px
    focal_px = views.intrinsics[:, :2] * focal[:, None]
    middle_px = views.intrinsics[:, 2:] + strength[:, None] * center_px
    return views.with_arrays(
        {
            "intrinsics": np.concatenate([focal_px, middle_px], axis=1),
            "sensor_strength": strength,
            "depth_scale_error": rng.uniform(-sensor.depth_scale, sensor.depth_scale, n),
            "depth_offset_m": rng.uniform(-sensor.depth_offset_m, sensor.depth_offset_m, n),
        }
    )


def with_dark(views: CameraPoses, boxes: Floats, missing: Floats) -> CameraPoses:
    """The same cameras with dark boxes (n, K, 4, 3), given in the world frame, in what they see.

    Args:
        views: n cameras.
        boxes: centres, and axes over half extents.
        missing: (n, K) share of the pixels that they miss on each.
    """
    centers = boxes[:, :, :1] - views.position_m[:, None, None]
    local = np.concatenate([centers, boxes[:, :, 1:]], axis=2) @ views.rotation[:, None]
    return views.with_arrays({"dark": local, "dark_missing": missing})


def overviews(n: int, **other: Any) -> CameraPoses:
    """The overview n times, never moved; `other` are fields of its `Camera` to have otherwise."""
    camera = OVERVIEW.model_copy(update=other)
    return sample_views(camera, np.random.default_rng(0), n, position_m=0.0, rotation_deg=0.0)


def project(views: CameraPoses, points_m: Floats) -> Floats:
    """Pixel coordinates (n, k, 2) and depth of world points (n, k, 3), as (n, k, 3): u, v, z."""
    local = (points_m - views.position_m[:, None]) @ views.rotation
    fx, fy, cx, cy = views.intrinsics.T[..., None]
    depth = local[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    u = cx + fx * local[..., 0] / safe
    v = cy + fy * local[..., 1] / safe
    return np.stack([u, v, depth], axis=-1)
