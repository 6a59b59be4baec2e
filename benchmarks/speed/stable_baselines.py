"""Stable-Baselines3's PPO as a contender. Needs the extra `bench`."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from benchmarks.peers import PeerVecEnv
from benchmarks.speed.setup import CAMERA, Setup
from encoders.conv import Paper
from encoders.layers import dense
from envs.grasp.env import make_vector_env
from trainers.common.timers import timed


class StableBaselines:
    """Trains on this project's environment, with a network of the same layers."""

    def __init__(self, setup: Setup):
        env = make_vector_env(rewards=setup.rewards, **setup.environment())
        encoder = Paper(
            env.single_observation_space[CAMERA],  # type: ignore[arg-type]
            Paper.Settings(size=setup.size),
        )
        self._env, self._buffer_size = PeerVecEnv(env), setup.buffer_size
        self._ppo = _TimedPPO(
            "CnnPolicy",
            self._env,
            learning_rate=setup.learning_rate,
            n_steps=setup.num_steps,
            batch_size=setup.batch_size,
            n_epochs=setup.num_epochs,
            gamma=setup.gamma,
            gae_lambda=setup.lambd,
            clip_range=setup.epsilon,
            ent_coef=setup.beta,
            policy_kwargs={
                "features_extractor_class": _Extractor,
                "features_extractor_kwargs": {"encoder": encoder, "setup": setup},
                # The trunk is in the extractor, where actor and critic share it.
                "net_arch": [],
                "optimizer_kwargs": {"eps": 1e-5, "fused": True},
            },
            device="cpu",
            seed=0,
        )
        self.parameters = sum(parameter.numel() for parameter in self._ppo.policy.parameters())

    def learn(self) -> None:
        """See `benchmarks.speed.training.Contender`."""
        self._ppo.learn(self._buffer_size, reset_num_timesteps=False)

    def close(self) -> None:
        """See `benchmarks.speed.training.Contender`."""
        self._env.close()


class _Extractor(BaseFeaturesExtractor):
    """The paper's convolutions and the trunk."""

    def __init__(self, space: Any, encoder: Paper, setup: Setup):
        super().__init__(space, setup.hidden_units)
        widths = [encoder.features_dim] + [setup.hidden_units] * setup.num_layers
        trunk = [dense(*sides, "relu") for sides in pairwise(widths)]
        self.layers = nn.Sequential(encoder.convolutions, nn.Flatten(), *trunk)

    def forward(self, images: Tensor) -> Tensor:
        """Images (B, 1, H, W), scaled to [0, 1] by Stable-Baselines3, to (B, hidden_units)."""
        hidden: Tensor = self.layers(images)
        return hidden


class _TimedPPO(PPO):
    def collect_rollouts(self, *arguments: Any, **options: Any) -> bool:
        with timed("collect"):
            return bool(super().collect_rollouts(*arguments, **options))

    def train(self) -> None:
        with timed("update"):
            super().train()
