"""A squashed Gaussian actor and twin critics with their targets."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from trainers.networks.actions import ActionScaling
from trainers.networks.actor_critic import ActorCriticSettings, observed
from trainers.networks.factory import NetworkFactory
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.network import Dense, head
from trainers.networks.observations import Observations
from trainers.networks.off_policy_network import OffPolicyNetwork, TargetAverage

MIN_LOG_STD, MAX_LOG_STD = -20.0, 2.0
Sees = tuple[str, ...]


class Actor(nn.Module):
    """A normal distribution N(mu(s), sigma(s)) of u, whose tanh is the action."""

    def __init__(self, factory: NetworkFactory, sees: Sees, settings: ActorCriticSettings):
        super().__init__()
        self.network = factory.network(settings, sees)
        size = ActionScaling(factory.action_space).size
        self.head = head(self.network.features_dim, 2 * size, gain=0.01)

    def forward(
        self, observations: Observations, frame_features: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean and logarithm of the standard deviation of u, both (B, A)."""
        mean, log_std = self.head(self.network(observations, frame_features)).chunk(2, dim=1)
        return mean, log_std.clamp(MIN_LOG_STD, MAX_LOG_STD)


def sample(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Actions (B, A) in [-1, 1] of standard normal noise (B, A), and their log densities (B,).

    Source: Haarnoja et al. 2018, appendix C.
    """
    u = mean + log_std.exp() * noise
    log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    # log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)), without cancellation for large |u|
    log_slope = 2.0 * (math.log(2.0) - u - F.softplus(-2.0 * u))
    return u.tanh(), (log_normal - log_slope).sum(dim=1)


class Critic(nn.Module):
    """Q(s, a), with encoders of its own."""

    def __init__(self, factory: NetworkFactory, sees: Sees, settings: ActorCriticSettings):
        super().__init__()
        self.encoder = factory.encoders(settings, sees)
        inputs = self.encoder.features_dim + ActionScaling(factory.action_space).size
        self.layers = Dense(inputs, 1, gain=1.0, settings=settings)

    def forward(self, observations: Observations, actions: Tensor) -> Tensor:
        """Values (B,) of actions (B, A) in [-1, 1]."""
        values: Tensor = self.layers(torch.cat((self.encoder(observations), actions), dim=1))
        return values.squeeze(1)


class SACPolicy(OffPolicyNetwork):
    """The actor, the twin critics, their targets that follow by `tau`, and the temperature."""

    def __init__(
        self, factory: NetworkFactory, settings: ActorCriticSettings, tau: float, alpha: float
    ):
        super().__init__()
        self.sees, self.critic_sees = observed(factory, settings)
        self.scale = ActionScaling(factory.action_space)
        self.actor = Actor(factory, self.sees, settings)
        critics = [Critic(factory, self.critic_sees, settings) for _ in range(2)]
        self.critics = nn.ModuleList(critics)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(math.log(alpha)))
        self._networks = [self.actor.network, *(critic.encoder for critic in critics)]
        self._average = TargetAverage(self.targets, self.critics, tau)

    def act(
        self, observations: Observations, *, deterministic: bool, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """See `PolicyNetwork.act`."""
        mean, log_std = self.actor(observations)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        actions = mean.tanh() if deterministic else sample(mean, log_std, noise)[0]
        return self.scale(actions), self.initial_state(len(actions))

    def value(self, observations: Observations, actions: Tensor, *, target: bool) -> Tensor:
        """Values (2, B) of the twin critics or their targets."""
        critics = self.targets if target else self.critics
        return torch.stack([critic(observations, actions) for critic in critics])

    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """See `OffPolicyNetwork.encode_frames`."""
        return FrameFeatures(self.actor.network.encode_frames(frames))

    def update_targets(self) -> None:
        """See `OffPolicyNetwork.update_targets`."""
        self._average.update()

    def update_statistics(self, vectors: dict[str, Tensor]) -> None:
        """See `PolicyNetwork.update_statistics`."""
        for network in self._networks:
            network.update_statistics(vectors)
        self._average.copy_buffers()
