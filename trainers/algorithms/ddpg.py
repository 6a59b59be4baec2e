"""Deep Deterministic Policy Gradient (Lillicrap et al. 2015, arXiv:1509.02971)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.nn import functional as F

from trainers.algorithms.exploration import GaussianSettings, Noise, NoiseSettings
from trainers.algorithms.off_policy import (
    ACTOR,
    CRITIC,
    OffPolicyAlgorithm,
    OffPolicyHyperparameters,
    OffPolicySettings,
)
from trainers.distributed.states import EACH
from trainers.experience.env_runner import EnvRunner
from trainers.networks.deterministic import DeterministicPolicy, DeterministicSettings
from trainers.networks.factory import NetworkFactory
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.observations import Observations


class DDPGHyperparameters(OffPolicyHyperparameters, frozen=True, extra="forbid"):
    """Hyper-parameters of DDPG, with ML-Agents' names where the thing is the same."""

    noise: NoiseSettings = Field(
        default_factory=GaussianSettings, description="What is added to the actor's actions."
    )

    def sigma(self, run_fraction: float) -> float:
        """Size of the noise at a point of the run."""
        return self.noise.schedule.value(self.noise.sigma, run_fraction)


class DDPGSettings(OffPolicySettings, frozen=True, extra="forbid"):
    """The `trainer` section of a run with DDPG."""

    hyperparameters: DDPGHyperparameters = Field(
        default_factory=DDPGHyperparameters, description="Hyper-parameters of DDPG."
    )
    network_settings: DeterministicSettings = Field(
        default_factory=DeterministicSettings, description="Networks of the actor and the critic."
    )


class DDPG(OffPolicyAlgorithm):
    """DDPG from a replay buffer. See `trainers.algorithms.base.Algorithm`."""

    Settings = DDPGSettings
    tags: ClassVar[Mapping[str, str]] = {
        "Losses/Policy Loss": "Mean value of the policy's own actions, negated.",
        "Losses/Value Loss": "Mean squared error of the critic's values.",
        "Policy/Q Value": "Mean value of the actions in the buffer.",
        "Policy/Noise": "Deviation of the exploration noise, of actions in [-1, 1].",
        **OffPolicyAlgorithm.tags,
    }
    state_axes: ClassVar[Mapping[str, Any]] = {"noise": 0, "replay_buffer": EACH}
    policy: DeterministicPolicy
    _hyperparameters: DDPGHyperparameters

    def __init__(
        self,
        factory: NetworkFactory,
        settings: DDPGSettings,
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        policy = self.build_policy(factory, settings).to(device)
        parameters = {
            ACTOR: policy.online.actor_parameters(),
            CRITIC: policy.online.critic_parameters(),
        }
        super().__init__(policy, settings, parameters, env_runner, generator, device)
        hyper = settings.hyperparameters
        self._noise: Noise = hyper.noise.build(self._actions_shape, device)
        # Without a future there is no value to estimate, nor anything to observe.
        self._targets = self._bootstrapped_returns if hyper.gamma else self._buffer.rewards

    @staticmethod
    def build_policy(factory: NetworkFactory, settings: DDPGSettings) -> DeterministicPolicy:
        """See `Algorithm.build_policy`."""
        hyper = settings.hyperparameters
        sigma = hyper.sigma(1.0) * hyper.noise.deviation()
        return DeterministicPolicy(factory, settings.network_settings, hyper.tau, sigma)

    def state_dict(self) -> dict[str, Any]:
        """See `Algorithm.state_dict`."""
        return {**super().state_dict(), "noise": self._noise.state}

    def load_state_dict(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """See `Algorithm.load_state_dict`."""
        super().load_state_dict(weights, state)
        self._noise.state = state["noise"].to(self._device)

    # -- collecting ------------------------------------------------------------------------------

    def _explore(self, observations: Observations, features: FrameFeatures) -> Tensor:
        actions = self.policy.online.act(observations, features.actor)
        sigma = self._hyperparameters.sigma(self._env_runner.step_count / self._settings.max_steps)
        noise = self._noise.sample(self._generator, self._env_runner.share)
        return (actions + sigma * noise).clamp(-1.0, 1.0)

    def _episodes_ended(self, done: NDArray[np.bool_]) -> None:
        self._noise.restart(torch.from_numpy(done).to(self._device))

    # -- learning --------------------------------------------------------------------------------

    def _schedule(self, run_fraction: float) -> dict[str, float]:
        sigma = self._hyperparameters.sigma(run_fraction)
        return super()._schedule(run_fraction) | {"Policy/Noise": sigma}

    def _improve_critic(self, indices: Tensor) -> dict[str, Tensor]:
        """Optimizer step on the mean of (Q(s, a) - y)^2 (Lillicrap et al. 2015, algorithm 1)."""
        online = self.policy.online
        targets = self._targets(indices)
        observations = self._augment(self._buffer.observations(indices, online.critic_sees))
        values = online.value(observations, self._buffer.actions(indices))
        loss = F.mse_loss(values, targets)
        self._optimizer_step(CRITIC, loss)
        return {"Losses/Value Loss": loss, "Policy/Q Value": values.mean()}

    def _improve_actor(self, indices: Tensor) -> dict[str, Tensor]:
        """Optimizer step on the mean of -Q(s, mu(s))."""
        online = self.policy.online
        observations = self._augment(self._buffer.observations(indices, self._seen))
        loss = -online.value(observations, online.act(observations)).mean()
        self._optimizer_step(ACTOR, loss)
        return {"Losses/Policy Loss": loss}

    @torch.no_grad()
    def _bootstrapped_returns(self, indices: Tensor) -> Tensor:
        """Targets y = R + gamma^k Q'(s', mu'(s')), (B,); R is the return of k steps up to s'."""
        hyper, target = self._hyperparameters, self.policy.target
        returns, discounts, last = self._buffer.returns(indices, hyper.gamma, hyper.n_step)
        next_observations = self._augment(self._buffer.next_observations(last, self._seen))
        return returns + discounts * target.value(next_observations, target.act(next_observations))
