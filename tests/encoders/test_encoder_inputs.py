"""From raw observations to what a network takes."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from encoders.inputs import fill_gaps, image_input, nearest_surfaces, vector_input
from encoders.spaces import DepthImage, RgbImage


def test_channels_come_first_and_pixels_stay_in_place():
    raw = torch.zeros(2, 4, 5, 3, dtype=torch.uint8)
    raw[1, 2, 3, 0] = 255
    raw[0, 3, 1, 2] = 51
    images = image_input(RgbImage(4, 5))(raw)
    assert images.shape == (2, 3, 4, 5)
    assert images.dtype == torch.float32
    assert images[1, 0, 2, 3] == 1
    assert images[0, 2, 3, 1] == pytest.approx(0.2)
    assert images.count_nonzero() == 2


def test_depth_is_scaled_over_the_range():
    module = image_input(DepthImage(1, 6))
    raw = torch.from_numpy(np.array([0, 400, 800, 1200, 2000, 65535], dtype=np.uint16))
    scaled = module(raw.reshape(1, 1, 6, 1))
    assert module.channels == 1
    assert scaled.shape == (1, 1, 1, 6)
    assert scaled.flatten().tolist() == pytest.approx([1, 0, 0.25, 0.5, 1, 1], abs=1e-6)


def test_depth_bytes_are_scaled_over_the_range():
    module = image_input(DepthImage(1, 3, (0.5, 0.9), "uint8"))
    scaled = module(torch.tensor([0, 51, 255], dtype=torch.uint8).reshape(1, 1, 3, 1))
    assert scaled.flatten().tolist() == pytest.approx([1, 0.2, 1], abs=1e-6)


@pytest.mark.parametrize("range_m", [(0.4, 2.0), (0.0, 1.2345), (0.5006, 0.9)])
@pytest.mark.parametrize("encoding", ["uint8", "uint16"])
def test_every_code_is_scaled_as_the_depth_that_it_stands_for(encoding, range_m):
    space = DepthImage(1, 1, range_m, encoding)
    raw = torch.from_numpy(np.arange(np.iinfo(space.dtype).max + 1).astype(space.dtype))
    share = (space.decode(raw).double() - range_m[0]) / (range_m[1] - range_m[0])
    scaled = image_input(space)(raw.reshape(-1, 1, 1, 1)).flatten()
    assert torch.allclose(scaled.double(), share, rtol=0.0, atol=1e-6)


def test_the_validity_channel_tells_depths_from_nothing_seen():
    module = image_input(DepthImage(1, 5), validity_channel=True)
    raw = torch.from_numpy(np.array([0, 399, 400, 2000, 2001], dtype=np.uint16))
    scaled = module(raw.reshape(1, 1, 5, 1))
    assert module.channels == 2
    assert scaled.shape == (1, 2, 1, 5)
    assert scaled[0, 0, 0].tolist() == pytest.approx([1, 1, 0, 1, 1], abs=1e-6)
    assert scaled[0, 1, 0].tolist() == [0, 0, 1, 1, 0]


def test_only_depth_has_a_validity_channel():
    with pytest.raises(ValueError, match=r"validity_channel.*RgbImage\(4, 5\)"):
        image_input(RgbImage(4, 5), validity_channel=True)


INF = math.inf


def test_a_gap_gets_the_depth_of_the_line_through_it_that_is_nearest():
    # rows (4, 6), columns (2, 9), diagonals (1, 8) and (3, 7): the farther ends are 6, 9, 8, 7
    depth_m = torch.tensor([[[1.0, 2.0, 3.0], [4.0, INF, 6.0], [7.0, 9.0, 8.0]]])
    assert fill_gaps(depth_m)[0, 1, 1] == 6
    depth_m[0, 1, 2] = INF
    assert fill_gaps(depth_m)[0].tolist() == [[1, 2, 3], [4, 7, 8], [7, 9, 8]]


def test_a_gap_between_no_two_depths_stays():
    depth_m = torch.full((1, 4, 4), INF)
    depth_m[0, 1, 1] = depth_m[0, 0, 0] = 1.0
    assert torch.equal(fill_gaps(depth_m), depth_m)


@pytest.mark.parametrize("angle_deg", range(0, 360, 7))
@pytest.mark.parametrize("beyond_m", [1.5, INF])
def test_straight_edges_stay_where_they_are(angle_deg, beyond_m):
    rows, columns = np.mgrid[:21, :21] - 10.0
    angle = np.radians(angle_deg)
    distance_px = rows * np.cos(angle) + columns * np.sin(angle) - 0.3
    edge = torch.from_numpy(np.where(distance_px < 0, 0.8, beyond_m))[None]
    assert torch.equal(fill_gaps(edge), edge)
    for row, column in np.argwhere(np.ones((17, 17))) + 2:  # each pixel missing, one by one
        holed = edge.clone()
        holed[0, row, column] = INF
        own_side = fill_gaps(holed)[0, row, column] == edge[0, row, column]
        assert own_side or -0.55 < distance_px[row, column] < 0


LARGEST = np.finfo(np.float32).max


@pytest.mark.parametrize(
    ("bounds", "raw", "scaled"),
    [
        ((0.0, 255.0), [0.0, 51.0, 255.0], [0.0, 0.2, 1.0]),
        ((-1.0, 1.0), [-1.0, -0.5, 1.0], [0.0, 0.25, 1.0]),
        ((0.0, 1.0), [0.0, 0.3, 1.0], [0.0, 0.3, 1.0]),
        ((20.0, 20.0), [20.0, 20.0, 20.0], [0.0, 0.0, 0.0]),
        ((-np.inf, np.inf), [-7.0, 0.0, 300.0], [-7.0, 0.0, 300.0]),
        ((0.0, np.inf), [0.0, 5.0, 300.0], [0.0, 5.0, 300.0]),
        ((-LARGEST, LARGEST), [-7.0, 0.0, 300.0], [-7.0, 0.0, 300.0]),
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_floats_are_scaled_over_their_bounds_if_they_have_any(bounds, raw, scaled, dtype):
    values = torch.from_numpy(np.array(raw, dtype).reshape(1, 1, 3, 1))
    before = values.clone()
    images = image_input(Box(*bounds, (1, 3, 1), dtype))(values)
    assert images.dtype == torch.float32
    assert images.shape == (1, 1, 1, 3)
    assert images.flatten().tolist() == pytest.approx(scaled, abs=1e-7)
    assert torch.equal(values, before)


def test_bounds_may_differ_from_channel_to_channel():
    low = np.broadcast_to(np.float32([0, -2, 0]), (1, 2, 3))
    high = np.broadcast_to(np.float32([10, 2, np.inf]), (1, 2, 3))
    raw = torch.tensor([[[[0.0, -2.0, 30.0], [5.0, 1.0, 40.0]]]])
    images = image_input(Box(low, high, dtype=np.float32))(raw)
    assert images[0, :, 0].tolist() == [[0.0, 0.5], [0.0, 0.75], [30.0, 40.0]]


def test_floats_from_0_to_1_and_bytes_are_the_same_to_the_last_bit():
    floats = torch.rand(2, 3, 4, 1)
    assert torch.equal(image_input(Box(0.0, 1.0, (3, 4, 1)))(floats), floats.permute(0, 3, 1, 2))
    codes = torch.arange(256, dtype=torch.uint8)
    expected = np.arange(256, dtype=np.float32) * np.float32(1 / 255)
    images = image_input(RgbImage(1, 256))(codes.reshape(1, 1, 256, 1).expand(-1, -1, -1, 3))
    np.testing.assert_array_equal(images[0, 2, 0].numpy(), expected)


def test_bytes_of_two_values_are_zeros_and_ones():
    images = image_input(Box(0, 1, (1, 2, 1), np.uint8))(torch.tensor([[[[0], [1]]]]).byte())
    assert images.flatten().tolist() == [0.0, 1.0]


def test_integers_of_unknown_meaning_are_refused():
    with pytest.raises(ValueError, match=r"uint16.*DepthImage"):
        image_input(Box(0, 65535, (8, 8, 1), dtype=np.uint16))


def test_vectors_become_float32():
    module = vector_input(Box(-1, 1, (3,), dtype=np.float64))
    values = module(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64))
    assert module.size == 3
    assert values.dtype == torch.float32
    assert values.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("build", [image_input, vector_input])
def test_matrices_are_neither_images_nor_vectors(build):
    with pytest.raises(ValueError, match=r"\(4, 5\).*neither"):
        build(Box(-1, 1, (4, 5)))


def test_the_nearest_surface_of_a_cell_is_the_mean_of_the_pixels_on_it():
    inf = torch.inf
    depth_m = torch.tensor([[1.00, 1.02, inf, inf], [1.01, 1.50, inf, 0.70]])[None]
    mean_m, coverage, missing = nearest_surfaces(depth_m, 2, 0.03)
    torch.testing.assert_close(mean_m, torch.tensor([[[1.01, 0.70]]]))
    torch.testing.assert_close(coverage, torch.tensor([[[0.75, 0.25]]]))
    torch.testing.assert_close(missing, torch.tensor([[[0.0, 0.75]]]))


def test_a_cell_without_a_depth_has_no_surface():
    mean_m, coverage, missing = nearest_surfaces(torch.full((1, 3, 3), torch.inf), 3, 0.03)
    assert (mean_m.item(), coverage.item(), missing.item()) == (torch.inf, 0.0, 1.0)


def test_cells_are_where_their_pixels_are():
    depth_m = torch.arange(24.0).reshape(1, 4, 6)
    mean_m, *_ = nearest_surfaces(depth_m, 2, 100.0)
    expected = depth_m.numpy().reshape(2, 2, 3, 2).mean((1, 3))
    torch.testing.assert_close(mean_m[0], torch.from_numpy(expected))


def test_cells_of_one_pixel_are_the_image_which_stays_as_it_is():
    depth_m = torch.tensor([[[0.5, torch.inf], [1.5, 2.0]]])
    before = depth_m.clone()
    mean_m, coverage, missing = nearest_surfaces(depth_m, 1, 0.03)
    assert torch.equal(depth_m, before)
    assert torch.equal(mean_m, before)
    assert coverage.tolist() == [[[1.0, 0.0], [1.0, 1.0]]]
    assert missing.tolist() == [[[0.0, 1.0], [0.0, 0.0]]]
