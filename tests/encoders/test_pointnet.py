"""The encoder ``pointnet``: what it computes, and what makes no difference to it."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st

from encoders.cameras import Pinhole
from encoders.pointnet import PointNet
from encoders.spaces import DepthImage, PointCloud, RgbImage

MIDDLE_M = (1.0, 0.0, 0.8)


def make(points, layers=(8, 5)):
    torch.manual_seed(0)
    return PointNet(PointCloud(points, "base", MIDDLE_M), PointNet.Settings(layers=layers))


def clouds(seed, batch, points, seen=1.0):
    rng = np.random.default_rng(seed)
    drawn = rng.normal(MIDDLE_M, 0.2, (batch, points, 3))
    there = rng.random((batch, points, 1)) < seen
    return torch.from_numpy(np.concatenate([drawn * there, there], axis=2).astype(np.float32))


def test_each_feature_is_the_largest_of_all_points():
    encoder = make(3, (2,))
    with torch.no_grad():
        encoder.layers[0][0].weight.copy_(torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -2.0]]))
        encoder.layers[0][0].bias.copy_(torch.tensor([0.0, 1.0]))
    cloud = torch.tensor([[[1.1, 0.0, 0.7, 1.0], [1.3, 0.0, 0.9, 1.0], [0.0, 0.0, 0.0, 0.0]]])
    # In decimetres from the middle: (1, 0, -1) and (3, 0, 1). max(1, 3); max(2 + 1, -2 + 1).
    torch.testing.assert_close(encoder(cloud), torch.tensor([[3.0, 3.0]]))


@given(seed=st.integers(0, 2**16), points=st.integers(1, 40))
@settings(max_examples=40, deadline=None)
def test_the_order_of_the_points_makes_no_difference(seed, points):
    cloud = clouds(seed, 2, points, seen=0.8)
    order = torch.from_numpy(np.random.default_rng(seed).permutation(points))
    encoder = make(points)
    torch.testing.assert_close(encoder(cloud[:, order]), encoder(cloud))


@given(
    seed=st.integers(0, 2**16),
    points=st.integers(1, 20),
    more=st.integers(1, 20),
    garbage=st.floats(-1e3, 1e3, width=32),
)
@settings(max_examples=40, deadline=None)
def test_rows_without_a_point_make_no_difference(seed, points, more, garbage):
    cloud = clouds(seed, 2, points)
    rows = torch.full((2, more, 4), garbage)
    rows[..., 3] = 0.0
    padded = torch.cat([rows[:, : more // 2], cloud, rows[:, more // 2 :]], dim=1)
    torch.testing.assert_close(make(points + more)(padded), make(points)(cloud))


def test_a_point_of_its_own_makes_a_difference():
    cloud = clouds(0, 1, 6)
    other = cloud.clone()
    other[0, 2, :3] += 0.5
    assert not torch.allclose(make(6)(cloud), make(6)(other))


@pytest.mark.parametrize("points", [5, 30])
def test_gradients_are_those_of_the_maximum(points):
    encoder = make(points)
    cloud = clouds(3, 20, points, seen=0.7)
    factors = torch.randn(20, 5)
    (first, _), (second, _) = encoder.layers
    shared = torch.relu(first(10.0 * (cloud[..., :3] - torch.tensor(MIDDLE_M))))
    there = cloud[..., 3:] > 0
    expected = torch.where(there, torch.relu(second(shared)), 0.0).max(dim=1).values
    parameters = list(encoder.parameters())
    wanted = torch.autograd.grad((expected * factors).sum(), parameters)
    found = encoder(cloud)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(torch.autograd.grad((found * factors).sum(), parameters), wanted)
    with torch.no_grad():
        torch.testing.assert_close(encoder(cloud), expected)


def test_clouds_without_points_have_finite_features_and_gradients():
    encoder = make(6)
    features = encoder(torch.zeros(2, 6, 4))
    assert (features == 0.0).all()
    (encoder(torch.cat([torch.zeros(1, 6, 4), clouds(0, 1, 6)])).square().sum()).backward()
    gradients = [parameter.grad for parameter in encoder.parameters()]
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert all(gradient.any() for gradient in gradients)


@pytest.mark.parametrize(
    ("space", "name"),
    [
        (DepthImage(8, 8, pinhole=Pinhole(9.0, 9.0, 4.0, 4.0)), "DepthImage"),
        (RgbImage(8, 8), "RgbImage"),
        (Box(-1, 1, (6,)), "Box"),
        (Box(-1, 1, (6, 4)), "Box"),
    ],
)
def test_other_observations_are_refused(space, name):
    with pytest.raises(ValueError, match=f"takes point clouds .*type: points.* and not {name}"):
        PointNet(space, PointNet.Settings())
