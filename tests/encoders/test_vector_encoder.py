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
    parts = batches([2, *sizes], seed)  # the first of several: what doesn't vary has no scale
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


LESSONS = torch.tensor(  # goal limits (dm, 0.1 rad) of the first two lessons of config/run.yaml
    [[1.0, 1.0, 1.2, 1.7453], [0.95, 0.95, 1.1444, 1.6678]], dtype=torch.float64
)


def test_what_was_constant_does_not_jump_when_it_first_moves():
    first, second = (lesson.expand(4096, 4) for lesson in LESSONS)
    step = (LESSONS[0] - LESSONS[1]).numpy()
    normalizer = RunningNormalizer(4)
    for _ in range(14):
        normalizer.update(first)
    assert normalizer(first[:1]).abs().max() < 1e-6
    np.testing.assert_allclose(normalizer(second[:1])[0], -step, rtol=1e-6)
    normalizer.update(second)
    # A fifteenth of the samples moved: mean c - d / 15, variance 14 / 15 + d^2 14 / 225; from the
    # moments alone it would be -sqrt(14) = -3.7, whatever d is.
    expected = -step * 14 / 15 / np.sqrt(14 / 15 + step**2 * 14 / 225)
    np.testing.assert_allclose(normalizer(second[:1])[0], expected, rtol=1e-6)


@given(seed=st.integers(0, 1000), offset=st.sampled_from([0.0, 0.1, -3.0, 1e4]))
def test_what_goes_on_varying_is_standardised_at_last(seed, offset):
    normalizer = RunningNormalizer(1)
    normalizer.update(torch.full((7, 1), offset, dtype=torch.float64))
    values = offset + np.random.default_rng(seed).normal(0.0, 0.5, (100_000, 1))
    for part in np.split(values, 100):
        normalizer.update(torch.from_numpy(part))
    assert normalizer.deviation.item() == pytest.approx(values.std(), rel=1e-3)
    assert normalizer.mean.item() == pytest.approx(values.mean(), abs=1e-3)


def test_an_event_that_no_one_has_seen_yet_is_no_outlier():
    normalizer = RunningNormalizer(1)
    for _ in range(100):
        normalizer.update(torch.zeros(1000, 1))
    normalizer.update(torch.nn.functional.one_hot(torch.tensor(0), 1000)[:, None])
    assert normalizer(torch.tensor([[1.0]])).item() == pytest.approx(1.0, abs=0.01)


def test_constant_through_one_batch_is_not_constant_so_far():
    normalizer = RunningNormalizer(1)
    normalizer.update(torch.tensor([[0.0], [2.0]]))
    normalizer.update(torch.tensor([[0.0], [0.0]]))  # 0, 2, 0, 0: mean 1/2, variance 3/4
    assert normalizer.mean.item() == 0.5
    assert normalizer.variance.item() == 0.75


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
