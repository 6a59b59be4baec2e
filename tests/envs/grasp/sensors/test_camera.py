from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from encoders.cameras import Sampling
from envs.grasp.sensors.camera import (
    CameraPoses,
    euler_rotations,
    look_at,
    pinhole,
    project,
    sample_views,
    sampling,
    sensor_pinhole,
)
from envs.grasp.settings import Camera

# A square 90 degree camera at (1, 2, 3) that looks along +x: focal length 50 px.
FORWARD = Camera(
    type="depth", width=100, height=60, fov_deg=90, position_m=(1, 2, 3), target_m=(5, 2, 3)
)


def fixed(camera: Camera, count: int = 1) -> CameraPoses:
    return sample_views(camera, np.random.default_rng(0), count, 0.0, 0.0)


def test_focal_length_comes_from_the_horizontal_field_of_view() -> None:
    assert sensor_pinhole(FORWARD).fx == pytest.approx(50.0)
    narrow = Camera(type="depth", width=80, fov_deg=60)
    assert sensor_pinhole(narrow).fx == pytest.approx(40 * np.sqrt(3))


def test_project_hand_computed() -> None:
    points = np.array([[(3, 2, 3), (3, 1, 3), (3, 2, 3.5), (6, 3, 2), (0, 2, 3)]], float)
    # to the right of a camera that looks along x is -y; rows count downwards
    np.testing.assert_allclose(
        project(fixed(FORWARD), points),
        [[(50, 30, 2), (75, 30, 2), (50, 17.5, 2), (40, 40, 5), (50, 30, -1)]],
        atol=1e-12,
    )


def test_project_takes_each_environments_own_camera() -> None:
    views = fixed(FORWARD, 2).with_arrays({"position_m": np.array([(1.0, 2, 3), (2.0, 2, 3)])})
    points = np.tile([3.0, 1.0, 3.0], (2, 1, 1))
    np.testing.assert_allclose(project(views, points), [[(75, 30, 2)], [(100, 30, 1)]])


@pytest.mark.parametrize(
    ("target", "right", "down"),
    [
        ((5, 0, 0), (0, -1, 0), (0, 0, -1)),
        ((0, 5, 0), (1, 0, 0), (0, 0, -1)),
        ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
        ((1, 0, -1), (0, -1, 0), (-np.sqrt(0.5), 0, -np.sqrt(0.5))),
        ((0, 0, -2), (0, -1, 0), (-1, 0, 0)),  # straight down: the image's top is +x
    ],
)
def test_look_at_hand_computed(
    target: tuple[float, ...], right: tuple[float, ...], down: tuple[float, ...]
) -> None:
    axes = look_at(np.zeros(3), np.array(target, float))
    expected = np.stack([right, down, np.array(target) / np.linalg.norm(target)], axis=1)
    np.testing.assert_allclose(axes, expected, atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_rolled_camera_sees_the_world_turned_the_other_way() -> None:
    axes = look_at(np.zeros(3), np.array([5.0, 0, 0]), np.pi / 2)
    # Turned clockwise by a quarter, what was to its right (-y) is now up in its image.
    expected = np.stack([(0, 0, -1), (0, 1, 0), (1, 0, 0)], axis=1)
    np.testing.assert_allclose(axes, expected, atol=1e-12)


def test_roll_leaves_the_middle_of_the_image_where_it_is() -> None:
    upright = Camera(type="depth", width=80, height=80)
    rolled = upright.model_copy(update={"roll_deg": 45.0})
    points = np.array([upright.target_m, (1.0, 0.2, 0.7)])[None]
    before = project(fixed(upright), points)[0]
    after = project(fixed(rolled), points)[0]
    assert after[0] == pytest.approx(before[0])
    # A turn of the camera by +45 degrees turns the image by -45 about its middle.
    cosine = np.sqrt(0.5)
    turned = np.array([[cosine, cosine], [-cosine, cosine]]) @ (before[1, :2] - 40.0) + 40.0
    np.testing.assert_allclose(after[1], [*turned, before[1, 2]], atol=1e-9)


def test_the_point_looked_at_is_in_the_middle_of_the_image() -> None:
    camera = Camera(type="depth", width=90, height=70)
    u, v, depth = project(fixed(camera), np.array(camera.target_m)[None, None])[0, 0]
    assert (u, v) == pytest.approx((45.0, 35.0))
    distance = np.subtract(camera.target_m, camera.position_m)
    assert depth == pytest.approx(np.sqrt((distance**2).sum()))


def test_euler_rotations_turn_about_x_then_y_then_z() -> None:
    quarter = np.pi / 2
    turns = euler_rotations(
        np.array([(quarter, 0, 0), (0, quarter, 0), (0, 0, quarter), (quarter, quarter, 0)])
    )
    x, y, z = np.eye(3)
    np.testing.assert_allclose(turns[0], np.stack([x, z, -y], 1), atol=1e-12)
    np.testing.assert_allclose(turns[1], np.stack([-z, y, x], 1), atol=1e-12)
    np.testing.assert_allclose(turns[2], np.stack([y, -x, z], 1), atol=1e-12)
    np.testing.assert_allclose(turns[3], turns[1] @ turns[0], atol=1e-12)


def test_sampled_views_stay_in_their_ranges_and_use_them() -> None:
    camera = Camera(type="depth", noise_sigma_m=0.004, missing_fraction=(0.1, 0.3))
    views = sample_views(camera, np.random.default_rng(0), 3000, 0.02, 3.0)
    moved = views.position_m - camera.position_m
    assert np.abs(moved).max() <= 0.02
    assert (np.abs(moved).max(0) > 0.0195).all()
    np.testing.assert_allclose(
        views.rotation @ np.swapaxes(views.rotation, 1, 2),
        np.tile(np.eye(3), (3000, 1, 1)),
        atol=1e-9,
    )
    square = look_at(np.array(camera.position_m), np.array(camera.target_m))
    relative = square.T @ views.rotation
    angle = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert 4.2 < angle.max() <= 3 * np.sqrt(3) + 0.1
    for values, (low, high) in (
        (views.near_m, (0.05, 0.1)),
        (views.far_m, (2.5, 3.0)),
        (views.missing_fraction, (0.1, 0.3)),
    ):
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < values.max() <= high
    np.testing.assert_array_equal(views.noise_sigma_m, 0.004)


def test_fields_of_view_of_their_own_across_and_down() -> None:
    astra = sensor_pinhole(Camera(type="depth", width=640, height=480, fov_deg=(60.0, 49.5)))
    assert astra.fx == pytest.approx(320 * np.sqrt(3))
    assert astra.fy == pytest.approx(240 / np.tan(np.radians(24.75)))
    assert (astra.cx, astra.cy) == (320.0, 240.0)


def test_a_calibrated_camera_is_taken_at_its_word() -> None:
    known = {"fx": 580.0, "fy": 570.0, "cx": 315.0, "cy": 245.5}
    camera = Camera.model_validate({"type": "depth", "intrinsics": known})
    assert dataclasses.asdict(sensor_pinhole(camera)) == known


def test_every_so_manyth_pixel_of_a_crop() -> None:
    camera = Camera.model_validate(
        {
            "type": "depth",
            "width": 640,
            "height": 480,
            "sampling": {"crop": [10, 20, 601, 400], "every": 6},
        }
    )
    assert sampling(camera) == Sampling(640, 480, 10, 20, 101, 67, 6)
    assert pinhole(camera).fx == pytest.approx(sensor_pinhole(camera).fx / 6)
