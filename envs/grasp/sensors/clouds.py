"""Point clouds from depth images, made as a robot makes them: by the calibration it knows.

Where the camera really stands, and what its lens really is, differs from that in every episode.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import COORDINATES, DepthImage, PointCloud
from envs.grasp.sensors.camera import image_space, nominal_pose
from envs.grasp.settings import Camera
from envs.grasp.simulators.kernels.worlds import kernel
from envs.grasp.threefry import uniform

Floats = NDArray[np.float64]
Codes = NDArray[np.uint16]
Integers = NDArray[np.int64]
Clouds = NDArray[np.float32]


class Calibration(NamedTuple):
    """How P pixels become points.

    Attributes:
        rays: (P, 3) from the camera to the points at depth 1, along the axes of the clouds' frame.
        position_m: (3,) of the camera in that frame.
        first, last: codes that are depths.
        zero_m, codes_per_m: what they mean; see `DepthImage`.
    """

    rays: Floats
    position_m: Floats
    first: int
    last: int
    zero_m: float
    codes_per_m: float


class CloudCamera:
    """A camera of `type: points`: a depth camera, and what is made of its images.

    Args:
        camera: its settings.

    Attributes:
        depth: the depth images.
        space: the clouds.
    """

    def __init__(self, camera: Camera):
        depth, cloud = image_space(camera), camera.cloud
        assert isinstance(depth, DepthImage)
        assert depth.pinhole is not None
        in_base = cloud.frame == "base"
        position_m, rotation = nominal_pose(camera) if in_base else (np.zeros(3), np.eye(3))
        middle_m = position_m + rotation[:, 2] * np.sqrt(np.prod(depth.range_m))
        self.depth, self._rotation = depth, rotation
        self.space = PointCloud(cloud.points, cloud.frame, tuple(middle_m.tolist()))
        self._farthest = cloud.choice == "farthest"
        rays = depth.pinhole.rays(*depth.shape[:2]).reshape(-1, COORDINATES) @ rotation.T
        meaning = (*depth.codes, depth.zero_m, depth.codes_per_m)
        self._calibration = Calibration(np.ascontiguousarray(rays), position_m, *meaning)

    def clouds(self, images: NDArray[Any], seeds: NDArray[np.uint64]) -> Clouds:
        """Clouds (n, P, 4) of depth images.

        Args:
            images: (n, H, W, 1) as the sensor delivers them.
            seeds: (n,) of all that is random in each cloud.
        """
        clouds = np.zeros((len(images), *self.space.shape), np.float32)
        codes = images.reshape(len(images), -1).astype(np.uint16, copy=False)
        _fill_clouds(codes, self._calibration, seeds, self._farthest, clouds)
        return clouds

    def image(self, cloud: Clouds) -> NDArray[Any]:
        """The depth image (H, W, 1) of a cloud (P, 4): nothing is seen between its points."""
        height, width, _ = self.depth.shape
        points_m = cloud[cloud[:, COORDINATES] > 0.0, :COORDINATES] - self._calibration.position_m
        x, y, depth_m = (points_m @ self._rotation).T
        pinhole = self.depth.pinhole
        assert pinhole is not None
        columns = np.rint(pinhole.fx * x / depth_m + pinhole.cx - 0.5).astype(np.int64)
        rows = np.rint(pinhole.fy * y / depth_m + pinhole.cy - 0.5).astype(np.int64)
        seen_m = np.full((height, width), np.inf)
        seen_m[rows, columns] = depth_m
        return self.depth.encode(seen_m)


@lru_cache
def cloud_camera(camera: Camera) -> CloudCamera:
    """The camera of some settings, of which there is one."""
    return CloudCamera(camera)


@kernel()
def _fill_clouds(
    codes: Codes,
    calibration: Calibration,
    seeds: NDArray[np.uint64],
    farthest: bool,
    clouds: Clouds,
) -> None:
    """Fills clouds (n, P, 4) of zeros from the codes (n, pixels) of as many depth images."""
    count = codes.shape[1]
    pixels, points_m = np.empty(count, np.int64), np.empty((COORDINATES, count), np.float32)
    stream = np.empty(2, np.uint64)
    for row in range(len(codes)):
        seen = 0
        for pixel in range(count):
            if calibration.first <= codes[row, pixel] <= calibration.last:
                pixels[seen] = pixel
                seen += 1
        stream[0], stream[1] = seeds[row], np.uint64(0)
        taken = min(seen, clouds.shape[1])
        if farthest:
            _locate(codes[row], pixels, seen, calibration, points_m)
            _take_farthest(pixels, seen, taken, points_m, stream)
        else:
            _take_any(pixels, seen, taken, stream)
        _locate(codes[row], pixels, taken, calibration, points_m)
        for place in range(taken):
            for axis in range(COORDINATES):
                clouds[row, place, axis] = points_m[axis, place]
            clouds[row, place, COORDINATES] = 1.0


@kernel()
def _locate(
    codes: Codes, pixels: Integers, count: int, calibration: Calibration, points_m: Clouds
) -> None:
    """Writes the points (3, k or more) that the first of the pixels (k or more,) see."""
    for place in range(count):
        pixel = pixels[place]
        depth_m = codes[pixel] / calibration.codes_per_m + calibration.zero_m
        for axis in range(COORDINATES):
            ray = calibration.rays[pixel, axis]
            points_m[axis, place] = calibration.position_m[axis] + depth_m * ray


@kernel()
def _take_any(pixels: Integers, seen: int, taken: int, stream: NDArray[np.uint64]) -> None:
    """Brings so many of the first pixels to the front, any set of them as likely as any other.

    The beginning of the shuffle of Fisher and Yates (Durstenfeld 1964).
    """
    for place in range(taken):
        other = int(uniform(stream, place, seen))
        pixels[place], pixels[other] = pixels[other], pixels[place]


@kernel()
def _take_farthest(
    pixels: Integers, seen: int, taken: int, points_m: Clouds, stream: NDArray[np.uint64]
) -> None:
    """Brings so many of the first pixels to the front: any, then always the farthest from those.

    Farthest-point sampling (Gonzalez 1985; Eldar et al. 1997), whose time grows with the pixels
    times the points. Points (3, k or more) are those of the pixels.
    """
    x, y, z = points_m
    chosen = np.empty(taken, np.int64)
    away = np.full(seen, np.float32(np.inf))  # the square of the distance to those that are chosen
    farthest = int(uniform(stream, 0, seen))
    for place in range(taken):
        chosen[place] = pixels[farthest]
        own_x, own_y, own_z = x[farthest], y[farthest], z[farthest]
        for other in range(seen):
            dx, dy, dz = x[other] - own_x, y[other] - own_y, z[other] - own_z
            square = dx * dx + dy * dy + dz * dz
            away[other] = square if square < away[other] else away[other]
        most = np.float32(-1.0)
        for other in range(seen):
            if away[other] > most:
                farthest, most = other, away[other]
    pixels[:taken] = chosen
