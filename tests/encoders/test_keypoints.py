"""The encoder ``keypoints``, held against geometry worked out apart from it."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from encoders.keypoints import Keypoints
from encoders.spaces import DepthImage, RgbImage

FOCAL_PX = 20.0
SPACE = DepthImage(16, 24, (0.4, 2.0), focal_length_px=FOCAL_PX)
MIDDLE_M = np.sqrt(0.4 * 2.0)


def make(space=SPACE, **settings):
    torch.manual_seed(0)
    return Keypoints(space, Keypoints.Settings(keypoints=3, patch=4, stride=2, **settings))


def attending_to_all(**settings):
    """An encoder whose attention is the same everywhere."""
    encoder = make(**settings)
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


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (RgbImage(16, 16), "only depth images"),
        (Box(-1, 1, (6,)), "only depth images"),
        (DepthImage(16, 16), "declare its DepthImage with focal_length_px"),
        (DepthImage(16, 3, focal_length_px=9.0), "3x16 image .* patch of 4 pixels"),
    ],
)
def test_spaces_that_make_no_points_are_refused(space, message):
    with pytest.raises(ValueError, match=message):
        make(space)
