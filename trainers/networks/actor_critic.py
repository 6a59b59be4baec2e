"""The actor and the critic of policy-gradient methods."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from trainers.common.errors import UserError
from trainers.networks.action_models import NETWORK_PATH, GaussianSettings, action_model
from trainers.networks.distributions import Distribution
from trainers.networks.factory import NetworkFactory
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.network import NetworkSettings, head
from trainers.networks.observations import Observations
from trainers.networks.policy_network import PolicyNetwork
from trainers.networks.recurrent import MemorySettings

ACTOR_GAIN = 0.01  # a small last layer: at first every observation gets nearly the same action
CRITIC_GAIN = 1.0
FORMER_LOG_STD = "log_std"  # its name in the weights, when Gaussians were not scaled


class ActorCriticSettings(NetworkSettings, frozen=True, extra="forbid"):
    """Networks of an actor and a critic, and what each of them sees."""

    actor_observations: tuple[str, ...] | None = Field(
        None,
        min_length=1,
        description="What the policy sees; null: all but those kept for a critic.",
    )
    critic_observations: tuple[str, ...] | None = Field(
        None,
        min_length=1,
        description="What a separate critic sees; null: what the policy sees.",
    )


class PolicySettings(GaussianSettings, ActorCriticSettings, frozen=True, extra="forbid"):
    """Networks of the actor and the critic."""

    critic: Literal["shared", "separate"] = Field(
        "shared", description="A critic on the actor's hidden vector, or one with its own network."
    )
    memory: MemorySettings | None = Field(
        None, description="A recurrent layer in the actor and in a separate critic; null: none."
    )

    @model_validator(mode="after")
    def _critic_can_see(self) -> PolicySettings:
        if self.critic == "shared" and self.critic_observations is not None:
            raise ValueError("critic_observations needs critic: separate")
        return self


class ActorCritic(PolicyNetwork):
    """A policy and a value function.

    Args:
        factory: builds the networks.
        settings: what they look like.

    Attributes:
        sequence_length: steps through which gradients flow back; 1 without memory.

    Raises:
        UserError: the settings don't fit the environment.
    """

    def __init__(self, factory: NetworkFactory, settings: PolicySettings):
        super().__init__()
        actor, critic = observed(factory, settings)
        self.sees = actor
        self.actor = factory.network(settings, actor, settings.memory)
        self.critic = (
            factory.network(settings, critic, settings.memory)
            if settings.critic == "separate"
            else None
        )
        self.state_size = self.actor.state_size
        if self.critic is not None:
            self.state_size += self.critic.state_size
        self.sequence_length = 1 if settings.memory is None else settings.memory.sequence_length
        width = self.actor.features_dim
        self.action_model = action_model(factory.action_space, settings)
        self.action_head = head(width, self.action_model.outputs, ACTOR_GAIN)
        self.value_head = head(
            width if self.critic is None else self.critic.features_dim, 1, CRITIC_GAIN
        )

    def forward(
        self, observations: Observations, features: FrameFeatures | None = None
    ) -> tuple[Distribution, Tensor]:
        """The distribution of actions and the values (B,)."""
        distribution, values, _ = self.step(observations, features)
        return distribution, values

    def step(
        self, observations: Observations, features: FrameFeatures | None = None
    ) -> tuple[Distribution, Tensor, Tensor]:
        """The distribution of actions, the values (B,), and the hidden state (S, m) after."""
        known = features or FrameFeatures()
        seen_by_actor, seen_by_critic = self._split(observations)
        hidden, hidden_state = self.actor.forward_recurrent(seen_by_actor, known.actor)
        distribution, critic_hidden = self._distribution(hidden), hidden
        if self.critic is not None:
            critic_hidden, critic_hidden_state = self.critic.forward_recurrent(
                seen_by_critic, known.critic
            )
            hidden_state = torch.cat([hidden_state, critic_hidden_state], dim=1)
        return distribution, self._value(critic_hidden), hidden_state

    def distribution(self, observations: Observations) -> Distribution:
        """The distribution of actions alone."""
        return self._distribution(self.actor(self._split(observations)[0]))

    def value(self, observations: Observations, features: FrameFeatures | None = None) -> Tensor:
        """The values (B,) alone."""
        known = features or FrameFeatures()
        seen_by_actor, seen_by_critic = self._split(observations)
        if self.critic is None:
            return self._value(self.actor(seen_by_actor, known.actor))
        return self._value(self.critic(seen_by_critic, known.critic))

    def features(self, observations: Observations) -> tuple[Tensor, Tensor]:
        """See `PolicyNetwork.features`: the actor's hidden vectors."""
        hidden, hidden_state = self.actor.forward_recurrent(self._split(observations)[0])
        # A critic's hidden state is of no use here, and stays as it was at the beginning.
        size = self.state_size - self.actor.state_size
        unused = hidden_state.new_zeros(len(hidden_state), size)
        return hidden, torch.cat([hidden_state, unused], dim=1)

    def act_on(
        self, features: Tensor, *, deterministic: bool, generator: torch.Generator
    ) -> Tensor:
        """See `PolicyNetwork.act_on`."""
        distribution = self._distribution(features)
        draws = distribution.mode() if deterministic else distribution.sample(generator)
        return self.action_model.actions(draws)

    def exploration_std(self) -> Tensor | None:
        """See `PolicyNetwork.exploration_std`."""
        return self.action_model.exploration_std()

    def current_weights(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """See `PolicyNetwork.current_weights`: their Gaussian is in the environment's own units."""
        current = dict(weights)
        if FORMER_LOG_STD in current:
            log_std = current.pop(FORMER_LOG_STD)
            current["action_model.log_std"] = log_std
            current["action_model.scale.middle"] = torch.zeros_like(log_std)
            current["action_model.scale.half_range"] = torch.ones_like(log_std)
        return current

    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """Features of U frames by name, (U, H, W, C)."""
        critic = None if self.critic is None else self.critic.encode_frames(frames)
        return FrameFeatures(self.actor.encode_frames(frames), critic)

    def update_statistics(self, vectors: dict[str, Tensor]) -> None:
        """Shows vector observations to the encoders that standardise."""
        for network in filter(None, (self.actor, self.critic)):
            network.update_statistics(vectors)

    def actor_parameters(self) -> Iterator[nn.Parameter]:
        """Parameters of the policy; a shared network counts among them."""
        yield from self.actor.parameters()
        yield from self.action_head.parameters()
        yield from self.action_model.parameters()

    def critic_parameters(self) -> Iterator[nn.Parameter]:
        """Parameters of the value function alone."""
        if self.critic is not None:
            yield from self.critic.parameters()
        yield from self.value_head.parameters()

    def _distribution(self, hidden: Tensor) -> Distribution:
        distribution: Distribution = self.action_model(self.action_head(hidden))
        return distribution

    def _value(self, hidden: Tensor) -> Tensor:
        value: Tensor = self.value_head(hidden).squeeze(-1)
        return value

    def _split(self, observations: Observations) -> tuple[Observations, Observations]:
        """Observations with the actor's hidden state, and with the critic's."""
        sequences = observations.sequences
        if sequences is None or self.state_size == 0:
            return observations, observations
        actor, critic = sequences.hidden_state.tensor_split([self.actor.state_size], dim=1)
        return (
            replace(observations, sequences=replace(sequences, hidden_state=actor)),
            replace(observations, sequences=replace(sequences, hidden_state=critic)),
        )


def observed(
    factory: NetworkFactory, settings: ActorCriticSettings
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the observations that the actor and the critic see.

    Raises:
        UserError: the environment does not have them, or keeps all of its own for a critic.
    """
    everything = tuple(factory.observation_space.spaces)
    actor = settings.actor_observations or tuple(
        name for name in everything if name not in factory.privileged
    )
    if not actor:
        raise UserError(
            f"{NETWORK_PATH}.actor_observations: the environment keeps all its observations for a "
            f"critic, so name those that the policy sees: {', '.join(everything)}"
        )
    critic = settings.critic_observations or actor
    for path, names in (("actor_observations", actor), ("critic_observations", critic)):
        for name in names:
            factory.check_name(name, f"{NETWORK_PATH}.{path}")
    return actor, critic
