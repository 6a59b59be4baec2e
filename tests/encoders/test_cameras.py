from __future__ import annotations

import numpy as np
import pytest
import torch

from encoders.cameras import Pinhole, Sampling


def test_rays_go_through_the_centres_of_the_pixels() -> None:
    rays = Pinhole(2.0, 4.0, 1.0, 0.5).rays(2, 3)
    np.testing.assert_allclose(rays[..., 0], [[-0.25, 0.25, 0.75]] * 2)
    np.testing.assert_allclose(rays[..., 1], [[0.0] * 3, [0.25] * 3])
    np.testing.assert_allclose(rays[..., 2], 1.0)


@pytest.mark.parametrize("every", [1, 2, 5])
def test_a_pixel_that_is_taken_keeps_its_ray(every: int) -> None:
    sensor = Pinhole(55.0, 52.0, 31.0, 26.5)
    taken = Sampling(64, 48, 3, 7, 9, 8, every)
    rays = taken.pinhole(sensor).rays(8, 9)
    raw = np.moveaxis(sensor.rays(48, 64), -1, 0)
    np.testing.assert_allclose(np.moveaxis(rays, -1, 0), taken.take(raw), atol=1e-12)


def test_take_works_on_arrays_and_tensors_alike() -> None:
    raw = np.arange(2 * 6 * 8).reshape(2, 6, 8)
    taken = Sampling(8, 6, 1, 2, 3, 2, 3)
    np.testing.assert_array_equal(taken.take(raw)[0], [[17, 20, 23], [41, 44, 47]])
    np.testing.assert_array_equal(taken.take(torch.from_numpy(raw)), taken.take(raw))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((8, 6, 0, 0, 9, 6, 1), r"last pixel is \(8, 5\)"),
        ((8, 6, 1, 0, 3, 3, 3), r"last pixel is \(7, 6\)"),
        ((8, 6, -1, 0, 3, 3, 1), "places at 0"),
        ((8, 6, 0, 0, 3, 3, 0), "start at 1"),
    ],
)
def test_pixels_that_a_sensor_does_not_have_are_refused(fields, message) -> None:
    with pytest.raises(ValueError, match=message):
        Sampling(*fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((0.0, 1.0, 0.0, 0.0), "focal lengths of 0.0 and 1.0"),
        ((1.0, float("inf"), 0.0, 0.0), "inf"),
        ((1.0, 1.0, float("nan"), 0.0), r"axis at \(nan"),
    ],
)
def test_what_is_no_camera_is_refused(fields, message) -> None:
    with pytest.raises(ValueError, match=message):
        Pinhole(*fields)
