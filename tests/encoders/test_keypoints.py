"""The encoder ``keypoints``, held against geometry worked out apart from it."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from encoders.cameras import Pinhole
from encoders.inputs import fill_gaps
from encoders.keypoints import Keypoints
from encoders.spaces import DepthImage, RgbImage

FOCAL_PX = 20.0
PINHOLE = Pinhole(FOCAL_PX, FOCAL_PX, 12.0, 8.0)
SPACE = DepthImage(16, 24, (0.4, 2.0), pinhole=PINHOLE)
MIDDLE_M = np.sqrt(0.4 * 2.0)


def make(space=SPACE, **other):
    torch.manual_seed(0)
    return Keypoints(space, Keypoints.Settings(keypoints=3, patch=4, stride=2, **other))


def attending_to_all():
    """An encoder whose attention is the same everywhere."""
    encoder = make()
    torch.nn.init.zeros_(encoder.attention.weight)
    return encoder


def places(features):
    """Keypoints (B, 3, 3) and covariances (B, 3, 6) in metres of features (B, f)."""
    points = features[:, :9].reshape(-1, 3, 3).double() * 3 / 10
    points[..., 2] += MIDDLE_M
    return points.detach().numpy(), features[:, 9:27].reshape(-1, 3, 6).detach().numpy() / 100


def middles(depth_m):
    """Points (n, 3) at the patches' middles: every second pixel, starting with (1, 1)."""
    rows, columns = np.mgrid[1 : depth_m.shape[0] : 2, 1 : depth_m.shape[1] : 2]
    z = depth_m[rows, columns]
    x = (columns + 0.5 - depth_m.shape[1] / 2) / FOCAL_PX * z
    y = (rows + 0.5 - depth_m.shape[0] / 2) / FOCAL_PX * z
    return np.stack([x, y, z], -1).reshape(-1, 3)


def raw(depth_m):
    return torch.from_numpy(SPACE.encode(np.array(depth_m)[None]))


def test_keypoints_are_the_mean_and_covariance_of_the_points_seen():
    depth_m = np.random.default_rng(0).uniform(0.8, 1.0, (16, 24)).round(3)
    points = middles(depth_m)
    found, covariances = places(attending_to_all()(raw(depth_m)))
    upper = np.triu_indices(3)
    expected = np.cov(points.T, bias=True)[upper].clip(-0.03, 0.03)
    for place, covariance in zip(found[0], covariances[0], strict=True):
        np.testing.assert_allclose(place, points.mean(0), atol=1e-6)
        np.testing.assert_allclose(covariance, expected, atol=1e-6)


def test_the_covariance_tells_how_a_surface_is_turned():
    # The plane z = 0.9 + 0.3 x: seen along the ray (u, v, 1) at z = 0.9 / (1 - 0.3 u).
    u = (np.arange(24) + 0.5 - 12) / FOCAL_PX
    depth_m = np.tile(0.9 / (1 - 0.3 * u), (16, 1))
    encoder = attending_to_all()
    _, covariances = places(encoder(raw(depth_m)))
    points = middles(depth_m)
    assert np.cov(points.T, bias=True)[0, 0] > 0.03  # clipped: too wide a piece to tell
    depth_m[:, :8] = depth_m[:, 16:] = 5.0  # the piece in the middle alone
    _, covariances = places(encoder(raw(depth_m)))
    xx, _, xz = covariances[0, 0, :3]
    assert xz / xx == pytest.approx(0.3, abs=0.01)


def test_what_lies_beyond_the_range_gets_no_attention():
    depth_m = np.full((16, 24), 0.9)
    alone = depth_m.copy()
    alone[:, 12:] = np.inf
    place, _ = places(attending_to_all()(raw(alone)))
    np.testing.assert_allclose(
        place[0, 0], middles(depth_m[:, :12])[0:].mean(0) - [0.9 * 6 / FOCAL_PX, 0, 0], atol=1e-5
    )


def test_an_empty_image_has_finite_features_and_gradients():
    encoder = make()
    features = encoder(raw(np.full((16, 24), np.inf)))
    features.square().sum().backward()
    assert torch.isfinite(features).all()
    assert all(torch.isfinite(p.grad).all() for p in encoder.parameters())


def test_shapes_do_not_depend_on_how_far_away_they_are():
    bump = np.zeros((16, 24))
    bump[5:9, 7:12] = -0.03
    near, far = (make()._look(torch.from_numpy(bump[None] + z).float())[0] for z in (0.7, 1.4))
    torch.testing.assert_close(near, far, atol=1e-5, rtol=0)
    assert near.abs().max() == pytest.approx(0.6)  # 3 of 5 cm


def test_an_edge_counts_alike_however_far_the_background():
    step = np.full((16, 24), 0.8)
    step[:, 10:] = 1.0
    further = np.where(step > 0.9, 1.7, step)
    seen = [make()._look(torch.from_numpy(s[None]).float())[0] for s in (step, further)]
    torch.testing.assert_close(*seen)


def test_attention_at_the_start_is_not_the_same_everywhere():
    depth_m = np.random.default_rng(0).uniform(0.8, 1.0, (16, 24))
    place, _ = places(make()(raw(depth_m)))
    assert np.ptp(place[0], axis=0).max() > 0.02


def test_bfloat16_moves_keypoints_by_little():
    depth_m = np.random.default_rng(0).uniform(0.8, 1.0, (16, 24))
    exact, _ = places(make()(raw(depth_m)))
    lowered, _ = places(make(precision="bfloat16")(raw(depth_m)))
    assert 0 < np.abs(exact - lowered).max() < 0.01


def tilted():
    """A face turned by some 30 degrees, before a wall."""
    rows, columns = np.mgrid[:16, :24]
    depth_m = 0.9 + 0.02 * columns + 0.004 * rows
    depth_m[:, 17:] = 1.6
    return depth_m


def with_holes(images, missing):
    """Raw images in which nothing is seen at some pixels."""
    return images.view(torch.int16).masked_fill(missing, 0).view(torch.uint16)


@pytest.mark.parametrize("encoding", ["uint16", "uint8"])
@pytest.mark.parametrize("far_m", [1.6, 2.0])
def test_the_far_end_of_the_range_is_seen_in_both_encodings(encoding, far_m):
    space = DepthImage(16, 24, (0.4, far_m), encoding, PINHOLE)
    depth_m = np.full((1, 16, 24), far_m, np.float32)
    with torch.no_grad():
        depth_m = space.decode_seen(torch.from_numpy(space.encode(depth_m)))[..., 0]
        *_, seen = make(space)._look(depth_m)
    assert seen.all()


@given(row=st.integers(0, 15), column=st.integers(0, 23))
@settings(max_examples=40, deadline=None)
def test_a_missing_pixel_is_neutral(row, column):
    missing = torch.zeros(1, 16, 24, 1, dtype=torch.bool)
    missing[0, row, column] = True
    image, encoder = raw(tilted()), attending_to_all()
    depths_m = [
        fill_gaps(SPACE.decode_seen(one)[..., 0]) for one in (image, with_holes(image, missing))
    ]
    (shapes, points, _), (found_shapes, found_points, seen) = map(encoder._look, depths_m)
    # Nothing can be filled in in a corner, and one of the four is the middle of a patch.
    assert seen.all() == ((row, column) != (15, 23))
    assume(seen.all())
    # A step of depth between neighbours is 24 mm at most, or that of the edge at column 17.
    at_edge = column in (16, 17)
    limit_m = 0.5 if at_edge else 0.0241
    assert (points - found_points).abs().max() <= 10 * limit_m
    if not (at_edge or (row in (0, 15) and column in (0, 23))):
        assert (shapes - found_shapes).abs().max() <= 0.0241 / 0.05
    features, found = (encoder(one) for one in (image, with_holes(image, missing)))
    assert (features - found).abs().max() < 0.1


def test_one_missing_pixel_in_ten_moves_the_mean_of_points_by_a_few_millimetres():
    images, rng = raw(tilted()).expand(64, -1, -1, -1), np.random.default_rng(0)
    holed = with_holes(images, torch.from_numpy(rng.random(images.shape) < 0.1))
    whole, found = (places(attending_to_all()(one))[0] for one in (images, holed))
    error_m = np.linalg.norm(whole - found, axis=-1)
    assert 0.0 < np.median(error_m) < 0.003
    assert error_m.max() < 0.02


def test_a_middle_that_can_not_be_filled_in_gets_no_attention():
    missing = torch.zeros(1, 16, 24, 1, dtype=torch.bool)
    missing[0, :, 12:] = True
    holed = with_holes(raw(np.full((16, 24), 0.9)), missing)
    place, covariance = places(attending_to_all()(holed))
    points = middles(np.full((16, 24), 0.9)).reshape(8, 12, 3)[:, :6].reshape(-1, 3)
    np.testing.assert_allclose(place[0, 0], points.mean(0), atol=1e-5)
    expected = np.cov(points.T, bias=True)[np.triu_indices(3)].clip(-0.03, 0.03)
    np.testing.assert_allclose(covariance[0, 0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (RgbImage(16, 16), "only depth images"),
        (Box(-1, 1, (6,)), "only depth images"),
        (DepthImage(16, 16), "declare its DepthImage with a pinhole"),
        (DepthImage(16, 3, pinhole=PINHOLE), "3x16 image .* patch of 4 pixels"),
    ],
)
def test_spaces_that_make_no_points_are_refused(space, message):
    with pytest.raises(ValueError, match=message):
        make(space)


def test_another_camera_looks_along_its_own_rays():
    wider = Pinhole(15.0, 17.0, 11.0, 9.0)
    encoder = make()
    encoder.set_rays(wider.rays(16, 24))
    raw = torch.from_numpy(np.random.default_rng(0).integers(400, 2000, (2, 16, 24, 1), np.uint16))
    expected = make(DepthImage(16, 24, (0.4, 2.0), pinhole=wider))(raw)
    torch.testing.assert_close(encoder(raw), expected)
    assert not torch.allclose(make()(raw), expected)
