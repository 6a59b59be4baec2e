"""Clouds made of depth images, against geometry and sampling written down once more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from encoders.spaces import PointCloud
from envs.cameras import look_at
from envs.grasp.sensors.clouds import CloudCamera
from envs.grasp.sensors.structured_light import StructuredLight
from envs.grasp.settings import Camera, Cloud

WIDTH, HEIGHT, POINTS = 24, 16, 60
SEEDS = np.arange(1, 4, dtype=np.uint64)


def camera(**changed: Any) -> Camera:
    cloud = {"points": POINTS} | changed.pop("cloud", {})
    position_m, target_m = (0.3, 0.1, 1.2), (1.1, 0.0, 0.7)
    return Camera(
        type="points",
        width=WIDTH,
        height=HEIGHT,
        fov_deg=60.0,
        position_m=position_m,
        target_m=target_m,
        roll_deg=30.0,
        cloud=Cloud(**cloud),
        **changed,
    )


def images(seed: int = 0, missing: float = 0.3) -> np.ndarray:
    """Depth images in mm, in which some pixels are 0 or beyond the range."""
    rng = np.random.default_rng(seed)
    depths = rng.integers(500, 1900, (3, HEIGHT, WIDTH, 1)).astype(np.uint16)
    depths[rng.random(depths.shape) < missing / 2] = 0
    depths[rng.random(depths.shape) < missing / 2] = 2001
    return depths


def unprojected(image: np.ndarray, of: Camera) -> np.ndarray:
    """All points (k, 3) of one image, pixel by pixel."""
    focal = WIDTH / 2 / np.tan(np.radians(30.0))
    points = []
    for row, column in np.argwhere((image[..., 0] >= 400) & (image[..., 0] <= 2000)):
        z = image[row, column, 0] / 1000.0
        ray = [(column + 0.5 - WIDTH / 2) / focal, (row + 0.5 - HEIGHT / 2) / focal, 1.0]
        points.append(z * np.array(ray))
    if of.cloud.frame == "camera":
        return np.array(points)
    position_m = np.array(of.position_m)
    rotation = look_at(position_m, np.array(of.target_m), np.radians(of.roll_deg))
    return np.array(points) @ rotation.T + position_m


def distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=-1)


@pytest.mark.parametrize("choice", ["random", "farthest"])
@pytest.mark.parametrize("frame", ["camera", "base"])
def test_points_are_those_of_pixels_that_are_seen_each_once(frame: str, choice: str) -> None:
    settings = camera(cloud={"frame": frame, "choice": choice})
    maker, depths = CloudCamera(settings), images()
    clouds = maker.clouds(depths, SEEDS)
    assert clouds.shape == (3, POINTS, 4)
    assert clouds.dtype == np.float32
    assert (clouds[..., 3] == 1.0).all()
    for cloud, image in zip(clouds, depths, strict=True):
        off = distances(cloud[:, :3], unprojected(image, settings))
        assert off.min(axis=1).max() < 1e-6
        assert len(set(off.argmin(axis=1))) == POINTS


@pytest.mark.parametrize("choice", ["random", "farthest"])
def test_where_fewer_are_seen_all_of_them_are_there_and_the_rest_is_zeros(choice: str) -> None:
    depths = np.zeros((3, HEIGHT, WIDTH, 1), np.uint16)
    depths[0, 3, 4:9] = 900
    depths[1] = 399  # nearer than the range
    depths[2] = 2000
    settings = camera(cloud={"choice": choice})
    clouds = CloudCamera(settings).clouds(depths, SEEDS)
    assert clouds[..., 3].sum(axis=1).tolist() == [5, 0, POINTS]
    assert not clouds[0, 5:].any()
    assert not clouds[1].any()
    assert distances(unprojected(depths[0], settings), clouds[0, :5, :3]).min(axis=1).max() < 1e-6


def test_bytes_mean_their_metres() -> None:
    settings = camera(encoding="uint8", cloud={"frame": "camera"})
    depths = np.zeros((1, HEIGHT, WIDTH, 1), np.uint8)
    depths[0, 2, 5:7, 0] = 51, 255
    cloud = CloudCamera(settings).clouds(depths, SEEDS[:1])[0]
    # 0.4 + 51 / 255 * 1.6 and the end of the range
    np.testing.assert_allclose(sorted(cloud[cloud[:, 3] > 0, 2]), [0.72, 2.0], atol=1e-6)


def test_a_cloud_is_a_matter_of_its_image_and_its_seed() -> None:
    maker, depths = CloudCamera(camera()), images()
    clouds = maker.clouds(depths, SEEDS)
    np.testing.assert_array_equal(maker.clouds(depths[2:], SEEDS[2:]), clouds[2:])
    assert (maker.clouds(depths[2:], SEEDS[:1]) != clouds[2:]).any()


def test_every_pixel_is_drawn_equally_often() -> None:
    depths = images(missing=0.0)[:1].repeat(2000, axis=0)
    maker = CloudCamera(camera())
    drawn = maker.clouds(depths, np.arange(2000, dtype=np.uint64))
    points = unprojected(depths[0], camera())
    _, counts = np.unique(drawn[..., 0], return_counts=True)
    assert len(counts) == len(points) == WIDTH * HEIGHT
    share = POINTS / (WIDTH * HEIGHT)
    deviation = np.sqrt(2000 * share * (1 - share))
    off = (counts - 2000 * share) / deviation
    assert np.abs(off).max() < 5.0
    assert 0.8 < off.std() < 1.2


def test_each_point_is_the_farthest_from_those_before() -> None:
    settings = camera(cloud={"choice": "farthest"})
    depths = images()
    clouds = CloudCamera(settings).clouds(depths, SEEDS)
    for cloud, image in zip(clouds, depths, strict=True):
        away = np.full(POINTS, np.inf)
        points = unprojected(image, settings)
        for place in range(1, POINTS):
            away = distances(points, cloud[:place, :3]).min(axis=1)
            own = distances(cloud[place : place + 1, :3], cloud[:place, :3]).min()
            assert own == pytest.approx(away.max(), abs=1e-5)


def test_an_image_comes_back_from_its_cloud() -> None:
    depths = images()
    for frame in ("camera", "base"):
        maker = CloudCamera(camera(cloud={"points": WIDTH * HEIGHT, "frame": frame}))
        for image, cloud in zip(depths, maker.clouds(depths, SEEDS), strict=True):
            expected = np.where((image < 400) | (image > 2000), 0, image)
            np.testing.assert_array_equal(maker.image(cloud), expected)


def test_the_space_says_where_the_points_lie() -> None:
    # The optical axis, as far away as the geometric mean of 0.4 and 2.0 m.
    middle_m = np.sqrt(0.8)
    space = CloudCamera(camera(cloud={"frame": "camera"})).space
    assert space == PointCloud(POINTS, "camera", (0.0, 0.0, float(middle_m)))
    space = CloudCamera(camera()).space
    axis = np.array([0.8, -0.1, -0.5]) / np.linalg.norm([0.8, -0.1, -0.5])
    assert space.frame == "base"
    np.testing.assert_allclose(space.middle_m, [0.3, 0.1, 1.2] + middle_m * axis, atol=1e-6)


def test_any_sensor_can_be_behind_it() -> None:
    assert hash(camera(sensor=StructuredLight())) != hash(camera())
    with pytest.raises(ValueError, match=r"cloud.points 385 of 24x16 pixels"):
        camera(cloud={"points": WIDTH * HEIGHT + 1})
