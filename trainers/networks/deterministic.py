"""A deterministic actor and its critic Q(s, a), with the targets that follow them slowly."""

from __future__ import annotations

import copy
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor, nn

from trainers.networks.actions import ActionScaling
from trainers.networks.actor_critic import ACTOR_GAIN, CRITIC_GAIN, ActorCriticSettings, observed
from trainers.networks.factory import NetworkFactory
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.network import Dense, Network
from trainers.networks.observations import Observations
from trainers.networks.off_policy_network import OffPolicyNetwork, TargetAverage


def _refuse_memory(value: Any) -> None:
    if value is not None:
        raise ValueError(
            "ddpg has no memory, it learns from single steps: remove the key, or use "
            "trainer_type: ppo or trpo"
        )


class DeterministicSettings(ActorCriticSettings, frozen=True, extra="forbid"):
    """Networks of a deterministic actor and of its critic."""

    critic: Literal["separate", "shared"] = Field(
        "separate",
        description="A critic with encoders of its own, or encoders shared with the actor, which "
        "then learn from the critic's loss alone.",
    )
    memory: Annotated[Any, AfterValidator(_refuse_memory)] = Field(
        None, description="Always null: ddpg has no memory."
    )

    @model_validator(mode="after")
    def _critic_can_see(self) -> DeterministicSettings:
        if self.critic == "shared" and self.critic_observations is not None:
            raise ValueError("critic_observations needs critic: separate")
        return self


class DeterministicActorCritic(nn.Module):
    """Encoders, the actor mu(s) and the critic Q(s, a). Actions are scaled to [-1, 1].

    Args:
        factory: builds the encoders.
        settings: what the networks look like.

    Attributes:
        actor_sees: names of the observations.
        critic_sees: the same.

    Raises:
        UserError: the settings don't fit the environment.
    """

    def __init__(self, factory: NetworkFactory, settings: DeterministicSettings):
        super().__init__()
        self.actor_sees, self.critic_sees = observed(factory, settings)
        self.critic_encoder = factory.encoders(settings, self.critic_sees)
        self.actor_encoder: Network | None = None
        if settings.critic == "separate":
            self.actor_encoder = factory.encoders(settings, self.actor_sees)
        size = ActionScaling(factory.action_space).size
        actor_inputs = self._acting_encoder.features_dim
        self.actor = Dense(actor_inputs, size, ACTOR_GAIN, settings)
        critic_inputs = self.critic_encoder.features_dim + size
        self.critic = Dense(critic_inputs, 1, CRITIC_GAIN, settings)

    def act(self, observations: Observations, frame_features: Tensor | None = None) -> Tensor:
        """mu(s): actions (B, A) in [-1, 1]; `encode_frames` may have looked at the frames."""
        return self.act_on(self.features(observations, frame_features))

    def features(self, observations: Observations, frame_features: Tensor | None = None) -> Tensor:
        """What the actor sees of the observations, (B, F)."""
        features: Tensor = self._acting_encoder(observations, frame_features)
        return features.detach() if self.actor_encoder is None else features

    def act_on(self, features: Tensor) -> Tensor:
        """Actions (B, A) in [-1, 1] for features (B, F)."""
        actions: Tensor = self.actor(features).tanh()
        return actions

    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """The actor's features of U frames by name, (U, H, W, C)."""
        return FrameFeatures(self._acting_encoder.encode_frames(frames))

    @property
    def _acting_encoder(self) -> Network:
        """Encoders that the actor acts on: its own, or those it shares with the critic."""
        return self.critic_encoder if self.actor_encoder is None else self.actor_encoder

    def value(self, observations: Observations, actions: Tensor) -> Tensor:
        """Q(s, a), (B,)."""
        features = self.critic_encoder(observations)
        values: Tensor = self.critic(torch.cat((features, actions), dim=1))
        return values.squeeze(1)

    def actor_parameters(self) -> list[nn.Parameter]:
        """Parameters of the actor's loss."""
        own = [] if self.actor_encoder is None else list(self.actor_encoder.parameters())
        return [*own, *self.actor.parameters()]

    def critic_parameters(self) -> list[nn.Parameter]:
        """Parameters of the critic's loss."""
        return [*self.critic_encoder.parameters(), *self.critic.parameters()]


class DeterministicPolicy(OffPolicyNetwork):
    """The networks that learn, and their targets.

    Args:
        factory: builds the encoders.
        settings: what the networks look like.
        tau: how far the targets follow at a time.
        final_sigma: standard deviation of the exploration noise at the end of training.

    Attributes:
        online: what learns.
        target: what follows it.
    """

    def __init__(
        self,
        factory: NetworkFactory,
        settings: DeterministicSettings,
        tau: float,
        final_sigma: float = 0.0,
    ):
        super().__init__()
        self.online = DeterministicActorCritic(factory, settings)
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        self.sees, self.critic_sees = self.online.actor_sees, self.online.critic_sees
        self.scale = ActionScaling(factory.action_space)
        self._final_sigma = final_sigma
        self._average = TargetAverage(self.target, self.online, tau)

    def features(self, observations: Observations) -> tuple[Tensor, Tensor]:
        """See `PolicyNetwork.features`."""
        features = self.online.features(observations)
        return features, self.initial_state(len(features))

    def act_on(
        self, features: Tensor, *, deterministic: bool, generator: torch.Generator
    ) -> Tensor:
        """See `PolicyNetwork.act_on`; what is drawn has the noise of the run's end.

        No action is replaced by one of `random_actions`: those are drawn for the buffer's sake and
        say nothing of the policy.
        """
        actions = self.online.act_on(features)
        if not deterministic:
            noise = torch.randn(actions.shape, generator=generator, device=actions.device)
            actions = (actions + self._final_sigma * noise).clamp(-1.0, 1.0)
        return self.scale(actions)

    def exploration_std(self) -> Tensor:
        """See `PolicyNetwork.exploration_std`."""
        return self._final_sigma * self.scale.half_range

    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """See `OffPolicyNetwork.encode_frames`."""
        return self.online.encode_frames(frames)

    def update_targets(self) -> None:
        """See `OffPolicyNetwork.update_targets`."""
        self._average.update()

    def update_statistics(self, vectors: dict[str, Tensor]) -> None:
        """See `PolicyNetwork.update_statistics`; the targets see alike."""
        self.online.critic_encoder.update_statistics(vectors)
        if self.online.actor_encoder is not None:
            self.online.actor_encoder.update_statistics(vectors)
        self._average.copy_buffers()
