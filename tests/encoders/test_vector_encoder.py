"""The encoder for vectors and its running moments."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st

from encoders.normalizer import RunningNormalizer
from encoders.spaces import DepthImage
from encoders.vector import Vector

SPACE = Box(-np.inf, np.inf, (3,), dtype=np.float64)


def batches(sizes, seed):
    rng = np.random.default_rng(seed)
    return [rng.normal([1e4, -2.0, 0.0], [0.1, 30.0, 1e-3], (size, 3)) for size in sizes]


@given(sizes=st.lists(st.integers(0, 20), min_size=1, max_size=6), seed=st.integers(0, 1000))
def test_moments_are_those_of_all_batches_together(sizes, seed):
    parts = batches([*sizes, 2], seed)
    normalizer = RunningNormalizer(3)
    for part in parts:
        normalizer.update(torch.from_numpy(part))
    everything = np.concatenate(parts)
    np.testing.assert_allclose(normalizer.mean.numpy(), everything.mean(0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(normalizer.variance.numpy(), everything.var(0), rtol=1e-7)
    assert normalizer.count.item() == len(everything)


def test_output_is_standardised_float32():
    normalizer = RunningNormalizer(1)
    normalizer.update(torch.tensor([[1.0], [3.0]]))  # mean 2, variance 1
    values = normalizer(torch.tensor([[2.0], [4.5], [0.0]], dtype=torch.float64))
    assert values.dtype == torch.float32
    assert values.flatten().tolist() == pytest.approx([0, 2.5, -2], abs=1e-6)


@pytest.mark.parametrize("clip", [5.0, 1.5])
def test_output_is_clipped(clip):
    normalizer = RunningNormalizer(1, clip=clip)
    assert normalizer(torch.tensor([[100.0], [-100.0]])).flatten().tolist() == [clip, -clip]


def test_a_value_that_never_changes_gives_zero():
    normalizer = RunningNormalizer(1)
    normalizer.update(torch.full((10, 1), 0.1))
    assert normalizer(torch.tensor([[0.1]])).item() == 0


def test_before_any_update_values_pass():
    assert RunningNormalizer(1)(torch.tensor([[1.25]])).item() == pytest.approx(1.25)


def test_moments_are_saved_and_restored():
    normalizer, twin = RunningNormalizer(3), RunningNormalizer(3)
    normalizer.update(torch.from_numpy(batches([8], 0)[0]))
    twin.load_state_dict(normalizer.state_dict())
    more = torch.from_numpy(batches([5], 1)[0])
    normalizer.update(more)
    twin.update(more)
    assert torch.equal(twin.mean, normalizer.mean)
    assert torch.equal(twin.variance, normalizer.variance)
    assert twin.count.item() == 13


def test_the_encoder_learns_by_update_only():
    encoder = Vector(SPACE, Vector.Settings(normalize=True))
    raw = torch.from_numpy(batches([50], 0)[0])
    before = {name: value.clone() for name, value in encoder.state_dict().items()}
    encoder(raw)
    assert all(torch.equal(encoder.state_dict()[name], before[name]) for name in before)
    encoder.update_statistics(raw)
    features = encoder(raw)
    assert features.dtype == torch.float32
    assert features.shape == (50, encoder.features_dim)
    # float64 inside: an offset of 1e4 with a deviation of 0.1 keeps its detail
    torch.testing.assert_close(features.mean(0), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(features[:, 0].std(correction=0), torch.tensor(1.0))


def test_without_normalisation_values_pass_and_statistics_do_nothing():
    encoder = Vector(SPACE, Vector.Settings())
    raw = torch.tensor([[100.0, -7.0, 0.5]], dtype=torch.float64)
    encoder.update_statistics(raw)
    features = encoder(raw)
    assert encoder.features_dim == 3
    assert features.dtype == torch.float32
    assert features.tolist() == raw.tolist()
    assert not encoder.state_dict()


def test_gradients_pass_through_to_the_input():
    encoder = Vector(Box(-1, 1, (2,)), Vector.Settings(normalize=True))
    raw = torch.tensor([[0.5, 50.0]], requires_grad=True)
    encoder(raw).sum().backward()
    assert raw.grad is not None
    assert raw.grad.tolist() == [[pytest.approx(1.0), 0.0]]  # the second one is clipped


def test_an_image_is_refused_with_the_encoder_to_use():
    with pytest.raises(ValueError, match=r"\(80, 80, 1\).*'conv'"):
        Vector(DepthImage(80, 80), Vector.Settings())
