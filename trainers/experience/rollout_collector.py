"""Collecting rollouts with the present policy, for PPO and its like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainers.common.share import Share
from trainers.experience.collector import BehaviorOutput, CollectedStep, Collector
from trainers.experience.env_runner import EnvRunner
from trainers.experience.frames import FrameStore
from trainers.experience.returns import gae
from trainers.experience.reward_normalizer import RewardNormalizer
from trainers.experience.rollout import Rollout
from trainers.networks.actor_critic import ActorCritic
from trainers.networks.distributions import Distribution
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.observations import Observations, frames_differ
from trainers.networks.recurrent import number_sequences


@dataclass(frozen=True)
class Sampled:
    """What the policy drew for N observations, beside the actions that come of it.

    Attributes:
        distribution: that was drawn from.
        draws: (N, ...) as the distribution knows them.
        values: (N,) of the observations.
    """

    distribution: Distribution
    draws: Tensor
    values: Tensor


@dataclass(frozen=True)
class _RolloutStep:
    """One step of N environments as a rollout keeps it; the frames are in their store.

    Attributes:
        final_values: (N,) of the last observations of episodes that were cut off; else zero.
    """

    frame_index: Tensor
    vectors: dict[str, Tensor]
    hidden_state: Tensor
    actions: Tensor
    distribution: Distribution
    values: Tensor
    final_values: Tensor
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    cut_off: NDArray[np.bool_]


class SampledActions:
    """Draws actions from the policy's distribution. Implements `collector.Behavior`.

    Args:
        policy: the actor and the critic.
        generator: the source of the actions' randomness.
        share: the environments that it acts in.
        antithetic: every second step mirrors the noise of the one before. Where both are tries at
            the same observations, whatever is even in the noise cancels in the policy's gradient.
    """

    def __init__(
        self, policy: ActorCritic, generator: torch.Generator, share: Share, *, antithetic: bool
    ):
        self._policy, self._antithetic = policy, antithetic
        self._generator, self._share = generator, share
        self._noise: Tensor | None = None
        self.state_size = policy.state_size

    def begin(self) -> None:
        """The next step is the first of a pair."""
        self._noise = None

    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """See `Behavior.encode_frames`."""
        return self._policy.encode_frames(frames)

    def act(self, observations: Observations, features: FrameFeatures) -> BehaviorOutput[Sampled]:
        """See `Behavior.act`."""
        distribution, values, hidden_state = self._policy.step(observations, features)
        draws = self._draw(distribution)
        actions = self._policy.action_model.actions(draws)
        return BehaviorOutput(actions, hidden_state, Sampled(distribution, draws, values))

    def _draw(self, distribution: Distribution) -> Tensor:
        if self._noise is not None:
            draws, self._noise = distribution.mode() - self._noise, None
            return draws
        draws = distribution.sample(self._generator, self._share)
        if self._antithetic:
            self._noise = draws - distribution.mode()
        return draws


class RolloutCollector:
    """Collects T steps of each of N environments with a policy that does not change meanwhile.

    Args:
        policy: draws the actions and values the observations.
        env_runner: the environments.
        steps: T.
        generator: the source of the actions' randomness.
        device: where the policy lives.
        reward_normalizer: scales the rewards that are learned from; None: they stay as they are.
        antithetic: see `SampledActions`.
    """

    def __init__(
        self,
        policy: ActorCritic,
        env_runner: EnvRunner,
        steps: int,
        generator: torch.Generator,
        device: torch.device,
        reward_normalizer: RewardNormalizer | None = None,
        *,
        antithetic: bool = False,
    ):
        self._policy, self._env_runner, self._steps = policy, env_runner, steps
        self._device, self._reward_normalizer = device, reward_normalizer
        self._behavior = SampledActions(policy, generator, env_runner.share, antithetic=antithetic)
        self._collector = Collector(self._behavior, env_runner, device)

    @torch.no_grad()
    def collect(self, gamma: float, lambd: float) -> Rollout:
        """Collects a rollout, with advantages and returns.

        Raises:
            StopRequested: the run is to stop.
            NonFiniteError: a reward or an observation is NaN or infinite.
            RankFailure: another process of the run failed.
        """
        collector = self._collector
        frames = collector.frame_store(self._steps)
        collector.begin()
        self._behavior.begin()
        with self._env_runner.world.together():
            steps = [self._collect_step(frames) for _ in range(self._steps)]
        last = collector.to_tensors(self._env_runner.observations, collector.hidden_state)
        advantages, returns = self._estimate(steps, self._policy.value(last), gamma, lambd)
        frame_index = torch.cat([step.frame_index for step in steps])
        actions = torch.cat([step.actions for step in steps])
        distributions = [step.distribution for step in steps]
        distribution = type(distributions[0]).concatenate(distributions)
        groups = self._sequences(steps) if self._policy.state_size else frame_index
        return Rollout(
            share=self._env_runner.share,
            frames=frames.tensors(),
            frame_index=frame_index,
            shuffle_groups=groups,
            all_groups=self._env_runner.all_groups(groups),
            hidden_states=torch.cat([step.hidden_state for step in steps]),
            vectors={
                name: torch.cat([step.vectors[name] for step in steps]) for name in steps[0].vectors
            },
            actions=actions,
            log_probs=distribution.log_prob(actions),
            values=torch.cat([step.values for step in steps]),
            advantages=advantages.flatten(),
            returns=returns.flatten(),
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly."""
        normalizer = self._reward_normalizer
        return {
            "remembered": self._collector.hidden_state,  # checkpoints have always called it so
            "reward_normalizer": None if normalizer is None else normalizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state.

        Raises:
            ValueError: it is that of another memory.
        """
        before, hidden_state = self._collector.hidden_state, state["remembered"]
        if hidden_state.shape != before.shape:
            raise ValueError(f"hidden states of {hidden_state.shape}, not {before.shape}")
        self._collector.hidden_state = hidden_state.to(self._device)
        if self._reward_normalizer is not None:
            self._reward_normalizer.load_state_dict(state["reward_normalizer"])

    def _collect_step(self, frames: FrameStore) -> _RolloutStep:
        """Acts once in every environment."""
        collected = self._collector.collect_step(frames)
        sampled = collected.acted.output
        return _RolloutStep(
            frame_index=collected.frame_index,
            vectors=collected.vectors,
            hidden_state=collected.hidden_state,
            actions=sampled.draws,
            distribution=sampled.distribution,
            values=sampled.values,
            final_values=self._final_values(collected),
            reward=collected.step.reward,
            terminated=collected.step.terminated,
            cut_off=collected.step.cut_off,
        )

    def _final_values(self, step: CollectedStep[Sampled]) -> Tensor:
        hidden_state, collector = step.acted.hidden_state, self._collector
        values = torch.zeros(len(hidden_state), device=self._device)
        cut, final = np.flatnonzero(step.step.cut_off), step.step.final_observations
        if not len(cut) or final is None:
            return values
        # With frame grab an episode's last image is its first, whose features are known.
        differ = frames_differ(final, step.observations, collector.frame_names, cut)
        same, other = self._tensor(cut[~differ]), self._tensor(cut[differ])
        if len(same):
            vectors = collector.to_tensors(
                collector.without_frames(final), hidden_state[same], cut[~differ]
            )
            values[same] = self._policy.value(vectors, step.features.rows(same))
        if len(other):
            last = collector.to_tensors(final, hidden_state[other], cut[differ])
            values[other] = self._policy.value(last)
        return values

    def _sequences(self, steps: list[_RolloutStep]) -> Tensor:
        """Numbers (M,) of the sequences that the transitions belong to."""
        done = np.stack([step.terminated | step.cut_off for step in steps])
        return self._tensor(number_sequences(done, self._policy.sequence_length).ravel())

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self._device)

    def _estimate(
        self,
        steps: list[_RolloutStep],
        last_values: Tensor,
        gamma: float,
        lambd: float,
    ) -> tuple[Tensor, Tensor]:
        """Advantages and returns (T, N)."""

        def stack(name: str, dtype: torch.dtype) -> Tensor:
            array = np.stack([getattr(step, name) for step in steps])
            return torch.from_numpy(array).to(self._device, dtype)

        terminated, cut_off = stack("terminated", torch.bool), stack("cut_off", torch.bool)
        done = terminated | cut_off
        values = torch.stack([step.values for step in steps])
        final_values = torch.stack([step.final_values for step in steps])
        next_values = torch.cat([values[1:], last_values[None]])
        rewards = stack("reward", values.dtype)
        if self._reward_normalizer is not None:
            rewards = self._reward_normalizer(rewards, done, self._env_runner.all_rows)
        return gae(
            rewards,
            values,
            torch.where(cut_off, final_values, next_values),
            terminated,
            done,
            gamma=gamma,
            lambd=lambd,
        )
