"""Normalised rewards: against gymnasium's wrapper, and by hand."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorWrapper
from gymnasium.wrappers.vector import NormalizeReward
from torch import Tensor

from trainers.experience.reward_normalizer import RewardNormalizer

GAMMA = 0.95


class Recorder(VectorWrapper[Any, Any, Any, Any, Any]):
    """Keeps the raw rewards and the ends of episodes."""

    def __init__(self, env: Any):
        super().__init__(env)
        self.rewards: list[np.ndarray] = []
        self.done: list[np.ndarray] = []

    def step(self, actions: Any) -> Any:
        observations, reward, terminated, truncated, infos = self.env.step(actions)
        self.rewards.append(reward)
        self.done.append(terminated | truncated)
        return observations, reward, terminated, truncated, infos


@pytest.fixture(scope="module")
def pendulum() -> tuple[Tensor, Tensor, NormalizeReward[Any, Any], np.ndarray]:
    """Rewards (T, N), ends (T, N), gymnasium's wrapper, and what it made of the rewards."""
    makers = [lambda: gymnasium.make("Pendulum-v1", max_episode_steps=30)] * 4
    raw = Recorder(SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP))
    wrapper = NormalizeReward(raw, gamma=GAMMA)
    wrapper.reset(seed=1)
    wrapper.action_space.seed(1)
    normalized = np.array([wrapper.step(wrapper.action_space.sample())[1] for _ in range(100)])
    rewards, done = torch.tensor(np.array(raw.rewards)), torch.tensor(np.array(raw.done))
    assert done.sum() == 12
    return rewards, done, wrapper, normalized


@pytest.mark.parametrize("steps", [1, 7, 100])
def test_it_learns_the_scale_that_gymnasium_learns(pendulum: Any, steps: int) -> None:
    rewards, done, wrapper, _ = pendulum
    normalizer = RewardNormalizer(4, GAMMA)
    for part, ends in zip(rewards.split(steps), done.split(steps), strict=True):
        normalizer(part, ends)
    # gymnasium begins with a ten-thousandth of a made-up sample, and adds up in float32.
    assert normalizer.deviation == pytest.approx(np.sqrt(wrapper.return_rms.var), rel=1e-5)


def test_step_by_step_it_is_gymnasiums(pendulum: Any) -> None:
    rewards, done, _, normalized = pendulum
    normalizer = RewardNormalizer(4, GAMMA)
    ours = torch.cat([normalizer(rewards[t : t + 1], done[t : t + 1]) for t in range(100)])
    # After the first steps, where that sample weighs.
    np.testing.assert_allclose(ours[5:].numpy(), normalized[5:], rtol=1e-3)


def test_a_rollout_has_one_scale() -> None:
    normalizer = RewardNormalizer(1, 0.5)
    rewards, done = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[False], [True], [False]])
    # Sums: 1, 2 + 1 / 2 = 2.5, and after the end 3.
    sums = np.array([1.0, 2.5, 3.0])
    scaled = normalizer(rewards, done)
    np.testing.assert_allclose(scaled.flatten(), rewards.flatten() / sums.std(), rtol=1e-6)
    # The running episode's sum is carried on: 4 + 3 / 2.
    sums = np.append(sums, 5.5)
    scaled = normalizer(torch.tensor([[4.0]]), torch.tensor([[False]]))
    assert scaled.item() == pytest.approx(4.0 / sums.std(), rel=1e-6)


def test_rewards_far_from_the_usual_are_clipped_and_keep_their_sign() -> None:
    normalizer = RewardNormalizer(1, 0.0)
    rewards = torch.ones(1000, 1) * torch.tensor([1.0, -1.0]).repeat(500)[:, None]
    rewards[0], rewards[1] = 1e4, -1e4
    scaled = normalizer(rewards, torch.zeros(1000, 1, dtype=torch.bool))
    assert scaled[:2].flatten().tolist() == [10.0, -10.0]
    assert torch.equal(scaled.sign(), rewards.sign())


def test_rewards_that_are_all_the_same_do_no_harm() -> None:
    normalizer = RewardNormalizer(2, 0.9)
    zeros = normalizer(torch.zeros(5, 2), torch.zeros(5, 2, dtype=torch.bool))
    assert torch.equal(zeros, torch.zeros(5, 2))


def test_going_back_to_a_state_goes_on_the_same() -> None:
    normalizer, other = RewardNormalizer(3, GAMMA), RewardNormalizer(3, GAMMA)
    generator = torch.Generator().manual_seed(0)
    parts = [torch.randn(6, 3, generator=generator) for _ in range(3)]
    done = torch.rand(6, 3, generator=generator) < 0.2
    normalizer(parts[0], done)
    state = normalizer.state_dict()
    normalizer(parts[1], done)
    other.load_state_dict(state)
    other(parts[1], done)
    assert torch.equal(normalizer(parts[2], done), other(parts[2], done))
