"""What Stable-Baselines3 is given: the environment as it is, and a network like ours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from encoders.spaces import DepthImage
from envs.environment import Environment

pytest.importorskip("stable_baselines3")

from benchmarks.peers import PeerVecEnv
from benchmarks.speed.figures import FRAME_GRAB
from benchmarks.speed.stable_baselines import StableBaselines
from benchmarks.speed.training import Ventosa, load
from trainers.networks.actor_critic import ActorCritic
from trainers.networks.observations import Observations

HEIGHT, WIDTH = 5, 7


class Counting(Environment):
    """Shows how often it was stepped; at step 2, 1 is terminated, 2 truncated, and 3 both."""

    def __init__(self, *vectors: str):
        self.num_envs = 4
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        depth = DepthImage(HEIGHT, WIDTH, encoding="uint8")
        extra = {name: Box(-9.0, 9.0, (1,), np.float32) for name in vectors}
        self.single_observation_space = gymnasium.spaces.Dict({"depth": depth, **extra})
        self.actions: list[np.ndarray] = []
        self.seeds: list[Any] = []
        self.closed_times = 0
        self._vectors, self._count = vectors, np.zeros(4, int)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict]:
        self.seeds.append(seed)
        self._count[:] = 0
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        self.actions.append(actions)
        self._count += 1
        second = self._count == 2
        terminated = second & np.array([False, True, False, True])
        truncated = second & np.array([False, False, True, True])
        infos: dict[str, Any] = {}
        observations, done = self._observe(), terminated | truncated
        if done.any():
            infos = {"final_obs": observations, "_final_obs": done}
            self._count[done] = 0
            observations = self._observe()
        return observations, actions.sum(axis=1), terminated, truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        self.closed_times += 1

    def _observe(self) -> dict[str, Any]:
        ramp = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH, 1)
        counts = self._count.astype(np.uint8)[:, None, None, None]
        vectors = {name: self._count[:, None].astype(np.float32) for name in self._vectors}
        return {"depth": ramp + counts * 100, **vectors}


def actions(value: float) -> np.ndarray:
    return np.full((4, 2), value)


def test_a_lone_image_comes_channels_first_and_is_not_copied() -> None:
    env = PeerVecEnv(Counting())
    assert env.observation_space == Box(0, 255, (1, HEIGHT, WIDTH), np.uint8)
    images = env.reset()
    assert isinstance(images, np.ndarray)
    assert images.shape == (4, 1, HEIGHT, WIDTH)
    assert images.flags.c_contiguous
    assert not images.flags.owndata
    np.testing.assert_array_equal(images[0, 0, 1], np.arange(WIDTH, 2 * WIDTH))


def test_several_observations_come_as_a_dictionary() -> None:
    env = PeerVecEnv(Counting("pose"))
    assert set(env.observation_space.spaces) == {"depth", "pose"}
    observations = env.reset()
    assert isinstance(observations, dict)
    assert env.observation_space["pose"].contains(observations["pose"][0])
    assert env.observation_space["depth"].contains(observations["depth"][0])


def test_steps_are_handed_on() -> None:
    source = Counting()
    env = PeerVecEnv(source)
    env.reset()
    images, rewards, dones, infos = env.step(actions(0.25))
    assert len(source.actions) == 1
    np.testing.assert_array_equal(source.actions[0], actions(0.25))
    assert isinstance(images, np.ndarray)
    assert (images[:, 0, 0, 0] == 100).all()
    assert rewards.dtype == np.float32
    assert rewards.tolist() == [0.5] * 4
    assert dones.tolist() == [False] * 4
    assert infos == [{}] * 4


def test_an_ended_episode_shows_its_last_observation_and_how_it_ended() -> None:
    env = PeerVecEnv(Counting("pose"))
    env.reset()
    env.step(actions(0.0))
    observations, _, dones, infos = env.step(actions(0.0))
    assert dones.tolist() == [False, True, True, True]
    # The episodes that ended have begun again; the first goes on.
    assert isinstance(observations, dict)
    assert observations["pose"][:, 0].tolist() == [2.0, 0.0, 0.0, 0.0]
    assert infos[0] == {}
    assert [info["TimeLimit.truncated"] for info in infos[1:]] == [False, True, False]
    for info in infos[1:]:
        assert info["terminal_observation"]["pose"].tolist() == [2.0]
        assert info["terminal_observation"]["depth"].shape == (1, HEIGHT, WIDTH)
        assert info["terminal_observation"]["depth"][0, 0, 0] == 200


def test_rewards_may_be_written_to() -> None:
    env = PeerVecEnv(Counting())
    env.reset()
    taken = actions(0.25)
    _, rewards, *_ = env.step(taken)
    rewards += 1.0  # what Stable-Baselines3 does where an episode was truncated
    assert taken.tolist() == actions(0.25).tolist()


def test_a_seed_is_used_at_the_next_reset_alone() -> None:
    source = Counting()
    env = PeerVecEnv(source)
    env.seed(7)
    env.reset()
    env.reset()
    assert source.seeds == [7, None]


def test_the_environments_are_one_object() -> None:
    source = Counting()
    env = PeerVecEnv(source)
    assert env.get_attr("num_envs") == [4] * 4
    assert env.get_attr("num_envs", indices=[0, 2]) == [4, 4]
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * 4
    with pytest.raises(NotImplementedError, match="one object"):
        env.set_attr("num_envs", 3)
    with pytest.raises(NotImplementedError, match="one object"):
        env.env_method("reset")
    env.close()
    assert source.closed_times == 1


@pytest.mark.parametrize("size", [32, 80, 128])
def test_both_networks_compute_the_same(size: int) -> None:
    run = load(size, FRAME_GRAB, 16)
    ours, peer = Ventosa(run), StableBaselines(run)
    try:
        policy, theirs = ours.session.algorithm.policy, peer.model.policy
        assert isinstance(policy, ActorCritic)
        assert ours.parameters == peer.parameters
        _copy(theirs.features_extractor, [policy.actor.frame_encoders, policy.actor.trunk])
        _copy(theirs.action_net, [policy.action_head])
        _copy(theirs.value_net, [policy.value_head])
        # Without 0, which is "nothing seen" here, and the nearest depth there.
        images = torch.from_numpy(
            np.random.default_rng(0).integers(1, 256, (3, size, size, 1), np.uint8)
        )
        with torch.no_grad():
            distribution, values = policy(Observations({"depth": images}, {}))
            first = images.permute(0, 3, 1, 2)
            torch.testing.assert_close(distribution.mode(), theirs.get_distribution(first).mode())
            torch.testing.assert_close(values, theirs.predict_values(first)[:, 0])
    finally:
        ours.close()
        peer.close()


def _copy(into: torch.nn.Module, modules: Sequence[torch.nn.Module]) -> None:
    given = [parameter for module in modules for parameter in module.parameters()]
    with torch.no_grad():
        for mine, other in zip(into.parameters(), given, strict=True):
            mine.copy_(other)
