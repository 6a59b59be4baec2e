"""Exploration noise: its statistics, and that episodes do not hand it on."""

from __future__ import annotations

import math

import pytest
import torch
from pydantic import TypeAdapter, ValidationError

from trainers.algorithms.exploration import (
    GaussianSettings,
    NoiseSettings,
    OrnsteinUhlenbeckSettings,
)

CPU = torch.device("cpu")


def drifting(count: int, theta: float) -> tuple[torch.Tensor, torch.Generator]:
    """The noise of 300 steps in many environments, (300, N, 1)."""
    settings = OrnsteinUhlenbeckSettings(type="ornstein_uhlenbeck", theta=theta)
    noise, generator = settings.build((count, 1), CPU), torch.Generator().manual_seed(0)
    return torch.stack([noise.sample(generator) for _ in range(300)]), generator


def test_gaussian_noise_has_standard_deviation_one_and_no_memory() -> None:
    noise, generator = GaussianSettings().build((5_000, 2), CPU), torch.Generator().manual_seed(0)
    first, second = noise.sample(generator), noise.sample(generator)
    assert first.std().item() == pytest.approx(1.0, abs=0.03)
    assert first.mean().item() == pytest.approx(0.0, abs=0.03)
    assert (first * second).mean().item() == pytest.approx(0.0, abs=0.03)
    assert noise.state.numel() == 0


@pytest.mark.parametrize("theta", [0.05, 0.15, 1.5])
def test_drifting_noise_settles_at_the_deviation_of_the_continuous_process(theta: float) -> None:
    path, _ = drifting(4_000, theta)
    settings = OrnsteinUhlenbeckSettings(type="ornstein_uhlenbeck", theta=theta)
    for late in (path[150], path[299]):
        assert late.std().item() == pytest.approx(1.0 / math.sqrt(2.0 * theta), rel=0.04)
        assert late.std().item() == pytest.approx(settings.deviation(), rel=0.04)
        assert late.mean().item() == pytest.approx(0.0, abs=4 * late.std().item() / 60)


def test_drifting_noise_forgets_at_its_rate() -> None:
    path, _ = drifting(4_000, 0.15)
    variance = path[200].square().mean()
    for lag in (1, 5, 15):
        correlation = (path[200] * path[200 + lag]).mean() / variance
        assert correlation.item() == pytest.approx(math.exp(-0.15 * lag), abs=0.05)


def test_drifting_noise_starts_small_and_grows() -> None:
    path, _ = drifting(4_000, 0.15)
    # Var[x_t] = (1 - exp(-2 theta t)) / (2 theta)
    for t in (1, 4):
        expected = math.sqrt((1.0 - math.exp(-0.3 * t)) / 0.3)
        assert path[t - 1].std().item() == pytest.approx(expected, rel=0.04)


def test_each_environment_starts_anew_with_its_episode() -> None:
    settings = OrnsteinUhlenbeckSettings(type="ornstein_uhlenbeck")
    noise, generator = settings.build((3, 2), CPU), torch.Generator().manual_seed(0)
    for _ in range(20):
        before = noise.sample(generator)
    noise.restart(torch.tensor([False, True, False]))
    assert noise.state[1].tolist() == [0.0, 0.0]
    assert torch.equal(noise.state[[0, 2]], before[[0, 2]])
    assert before[1].abs().min() > 0  # what was handed out before is left as it was


def test_a_state_goes_on_as_it_would_have() -> None:
    settings = OrnsteinUhlenbeckSettings(type="ornstein_uhlenbeck")
    one, other = settings.build((2, 1), CPU), settings.build((2, 1), CPU)
    generator = torch.Generator().manual_seed(3)
    one.sample(generator)
    other.state, state = one.state, generator.get_state()
    expected = one.sample(generator)
    generator.set_state(state)
    assert torch.equal(other.sample(generator), expected)


def test_the_kind_is_chosen_by_its_type() -> None:
    kinds: TypeAdapter[NoiseSettings] = TypeAdapter(NoiseSettings)
    gaussian = kinds.validate_python({"type": "gaussian", "schedule": "linear", "sigma": 0.3})
    assert isinstance(gaussian, GaussianSettings)
    assert gaussian.schedule.value(gaussian.sigma, 0.5) == pytest.approx(0.15)
    drift = kinds.validate_python({"type": "ornstein_uhlenbeck", "theta": 0.3})
    assert isinstance(drift, OrnsteinUhlenbeckSettings)
    with pytest.raises(ValidationError, match="theta"):
        kinds.validate_python({"type": "gaussian", "theta": 0.3})
