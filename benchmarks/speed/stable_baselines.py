"""Stable-Baselines3's PPO as a contender. Needs the extra `bench`."""

from __future__ import annotations

from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from benchmarks.learning.theirs import ppo
from benchmarks.peers import PeerVecEnv
from encoders.conv import ConvolutionalEncoder
from trainers.common.timers import timed
from trainers.networks.network import NetworkSettings, hidden_layers
from trainers.runfile.settings import RunSettings
from trainers.session import build_environment


class StableBaselines:
    """Trains on this project's environment, with a network of the same layers."""

    def __init__(self, run: RunSettings):
        settings: Any = run.trainer.settings
        env = build_environment(run, run.seed)
        (camera,) = run.encoders
        encoder = run.encoders[camera]
        convolutions = encoder.cls(env.single_observation_space[camera], encoder.settings)
        self._env, self._buffer_size = PeerVecEnv(env), settings.hyperparameters.buffer_size
        options = ppo(settings, self._env)
        # The trunk is in the extractor, where actor and critic share it.
        options["policy_kwargs"] |= {
            "features_extractor_class": _Extractor,
            "features_extractor_kwargs": {
                "encoder": convolutions,
                "networks": settings.network_settings,
            },
            "net_arch": [],
        }
        self.model = _TimedPPO("CnnPolicy", self._env, seed=run.seed, device="cpu", **options)
        self.parameters = sum(parameter.numel() for parameter in self.model.policy.parameters())

    def learn(self) -> None:
        """See `benchmarks.speed.training.Contender`."""
        self.model.learn(self._buffer_size, reset_num_timesteps=False)

    def close(self) -> None:
        """See `benchmarks.speed.training.Contender`."""
        self._env.close()


class _Extractor(BaseFeaturesExtractor):
    """The run's convolutions and its trunk, as one network."""

    def __init__(self, space: Any, encoder: ConvolutionalEncoder, networks: NetworkSettings):
        trunk, width = hidden_layers(encoder.features_dim, networks)
        super().__init__(space, width)
        self.layers = nn.Sequential(encoder.convolutions, nn.Flatten(), trunk)

    def forward(self, images: Tensor) -> Tensor:
        """Images (B, 1, H, W), scaled to [0, 1] by Stable-Baselines3, to (B, hidden_units)."""
        hidden: Tensor = self.layers(images)
        return hidden


class _TimedPPO(PPO):
    collect_rollouts = timed("collect")(PPO.collect_rollouts)
    train = timed("update")(PPO.train)
