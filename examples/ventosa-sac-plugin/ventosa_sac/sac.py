"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018, arXiv:1812.05905)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional as F

from trainers.algorithms.off_policy import (
    ACTOR,
    CRITIC,
    OffPolicyAlgorithm,
    OffPolicyHyperparameters,
    OffPolicySettings,
)
from trainers.experience.env_runner import EnvRunner
from trainers.networks.actor_critic import ActorCriticSettings
from trainers.networks.factory import NetworkFactory
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.observations import Observations
from ventosa_sac.networks import SACPolicy, sample

TEMPERATURE = "temperature"


class SACHyperparameters(OffPolicyHyperparameters, frozen=True, extra="forbid"):
    """Hyper-parameters of SAC, with ML-Agents' names where the thing is the same."""

    learning_rate: float = Field(3e-4, gt=0.0, description="Of all networks, to begin with.")
    init_entropy_coefficient: float = Field(
        1.0, gt=0.0, description="Temperature alpha, the weight of the entropy, to begin with."
    )


class SACSettings(OffPolicySettings, frozen=True, extra="forbid"):
    """The `trainer` section of a run with SAC."""

    hyperparameters: SACHyperparameters = Field(
        default_factory=SACHyperparameters, description="Hyper-parameters of SAC."
    )
    network_settings: ActorCriticSettings = Field(
        default_factory=ActorCriticSettings, description="Networks of the actor and the critics."
    )


class SAC(OffPolicyAlgorithm):
    """SAC from a replay buffer. See `trainers.algorithms.base.Algorithm`."""

    Settings = SACSettings
    tags: ClassVar[Mapping[str, str]] = {
        "Losses/Policy Loss": "Mean of alpha log pi(a|s) - Q(s, a), of the policy's own actions.",
        "Losses/Value Loss": "Mean squared error of both critics' values, summed.",
        "Policy/Entropy": "Mean entropy of the distribution of actions, in nats.",
        "Policy/Entropy Coefficient": "Temperature alpha, the weight of the entropy.",
        **OffPolicyAlgorithm.tags,
    }
    policy: SACPolicy
    _hyperparameters: SACHyperparameters

    def __init__(
        self,
        factory: NetworkFactory,
        settings: SACSettings,
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        policy = self.build_policy(factory, settings).to(device)
        parameters = {
            ACTOR: list(policy.actor.parameters()),
            CRITIC: list(policy.critics.parameters()),
            TEMPERATURE: [policy.log_alpha],
        }
        super().__init__(policy, settings, parameters, env_runner, generator, device)
        self._target_entropy = -float(policy.scale.size)

    @staticmethod
    def build_policy(factory: NetworkFactory, settings: SACSettings) -> SACPolicy:
        """See `Algorithm.build_policy`."""
        hyper = settings.hyperparameters
        networks = settings.network_settings
        return SACPolicy(factory, networks, hyper.tau, hyper.init_entropy_coefficient)

    def _explore(self, observations: Observations, features: FrameFeatures) -> Tensor:
        return self._sample(observations, features.actor)[0]

    def _improve_critic(self, indices: Tensor) -> dict[str, Tensor]:
        """Optimizer step on the mean of (Q_i(s, a) - y)^2, summed over both critics (eq. 5)."""
        targets = self._targets(indices)
        observations = self._augment(self._buffer.observations(indices, self.policy.critic_sees))
        values = self.policy.value(observations, self._buffer.actions(indices), target=False)
        loss = len(values) * F.mse_loss(values, targets.expand_as(values))
        self._optimizer_step(CRITIC, loss)
        return {"Losses/Value Loss": loss}

    @torch.no_grad()
    def _targets(self, indices: Tensor) -> Tensor:
        """Y = R + gamma^k (min_i Q'_i(s', a') - alpha log pi(a'|s')), (B,)."""
        hyper = self._hyperparameters
        returns, discounts, last = self._buffer.returns(indices, hyper.gamma, hyper.n_step)
        observations = self._augment(self._buffer.next_observations(last, self._seen))
        actions, log_probs = self._sample(observations)
        values = self.policy.value(observations, actions, target=True).amin(dim=0)
        return returns + discounts * (values - self.policy.log_alpha.exp() * log_probs)

    def _improve_actor(self, indices: Tensor) -> dict[str, Tensor]:
        """Optimizer steps: mean of alpha log pi(a|s) - min_i Q_i(s, a) (eq. 9), then alpha."""
        alpha = self.policy.log_alpha.detach().exp()
        observations = self._augment(self._buffer.observations(indices, self._seen))
        actions, log_probs = self._sample(observations)
        values = self.policy.value(observations, actions, target=False).amin(dim=0)
        loss = (alpha * log_probs - values).mean()
        self._optimizer_step(ACTOR, loss)
        # J(alpha) = E[-alpha (log pi(a|s) + H)] (eq. 18), minimized in log alpha as is usual
        entropy = -log_probs.detach().mean()
        self._optimizer_step(TEMPERATURE, self.policy.log_alpha * (entropy - self._target_entropy))
        return {
            "Losses/Policy Loss": loss,
            "Policy/Entropy": entropy,
            "Policy/Entropy Coefficient": alpha,
        }

    def _sample(
        self, observations: Observations, frame_features: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Actions (B, A) in [-1, 1] and their log densities (B,)."""
        mean, log_std = self.policy.actor(observations, frame_features)
        noise = torch.randn(mean.shape, generator=self._generator, device=self._device)
        return sample(mean, log_std, noise)
