"""Collecting experience with the present policy, for PPO and its like."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainers.common.timers import timed
from trainers.experience.env_runner import EnvRunner, Step
from trainers.experience.returns import gae
from trainers.experience.reward_normalizer import RewardNormalizer
from trainers.experience.rollout import FrameStore, Rollout, frame_spaces
from trainers.networks.actor_critic import ActorCritic, FrameFeatures, to_environment
from trainers.networks.distributions import Distribution
from trainers.networks.observations import Observations, frames_differ, to_tensors
from trainers.networks.recurrent import Sequences, number_sequences


class OnPolicyCollector:
    """Plays T steps in each of N environments with a policy that does not change meanwhile.

    What the policy remembers of its running episodes is carried from one collection to the next.

    Args:
        policy: draws the actions and values the observations.
        env_runner: the environments.
        steps: T.
        generator: the source of the actions' randomness.
        device: where the policy lives.
        reward_normalizer: scales the rewards that are learned from; None: they stay as they are.
    """

    def __init__(
        self,
        policy: ActorCritic,
        env_runner: EnvRunner,
        steps: int,
        generator: torch.Generator,
        device: torch.device,
        reward_normalizer: RewardNormalizer | None = None,
    ):
        self._policy, self._env_runner, self._steps = policy, env_runner, steps
        self._generator, self._device = generator, device
        self._reward_normalizer = reward_normalizer
        env = env_runner.env
        self._space, self._action_space = env.single_observation_space, env.single_action_space
        self._remembered = policy.initial_state(env.num_envs)

    @torch.no_grad()
    def collect(self, gamma: float, lambd: float) -> Rollout:
        """Plays, and works out advantages and returns.

        Raises:
            NonFiniteError: a reward or an observation is NaN or infinite.
        """
        frames = _Frames(self._policy, self._env_runner, self._steps, self._device)
        moments = [self._play(frames) for _ in range(self._steps)]
        last = self._tensors(self._env_runner.observations, self._remembered)
        advantages, returns = self._estimate(moments, self._policy.value(last), gamma, lambd)
        frame_index = torch.cat([moment.frame_index for moment in moments])
        actions = torch.cat([moment.actions for moment in moments])
        policies = [moment.distribution for moment in moments]
        distribution = type(policies[0]).concatenate(policies)
        return Rollout(
            frames=frames.tensors(),
            frame_index=frame_index,
            shuffle_groups=self._sequences(moments) if self._policy.state_size else frame_index,
            states=torch.cat([moment.state for moment in moments]),
            vectors={
                name: torch.cat([moment.vectors[name] for moment in moments])
                for name in moments[0].vectors
            },
            actions=actions,
            log_probs=distribution.log_prob(actions),
            values=torch.cat([moment.values for moment in moments]),
            advantages=advantages.flatten(),
            returns=returns.flatten(),
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly."""
        normalizer = self._reward_normalizer
        return {
            "remembered": self._remembered,
            "reward_normalizer": None if normalizer is None else normalizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state."""
        self._remembered = state["remembered"].to(self._device)
        if self._reward_normalizer is not None:
            self._reward_normalizer.load_state_dict(state["reward_normalizer"])

    def _play(self, frames: _Frames) -> _Moment:
        """Acts once in every environment."""
        raw, state = self._env_runner.observations, self._remembered
        frame_index = frames.look(raw)
        with timed("act"):
            observations = self._tensors(frames.without(raw), state)
            distribution, values, after = self._policy.step(observations, frames.features)
            actions = distribution.sample(self._generator)
        step = self._env_runner.step(to_environment(actions, self._action_space))
        frames.new = np.flatnonzero(~step.same_frame)
        if self._policy.state_size:
            self._remembered = after.masked_fill(self._tensor(step.done)[:, None], 0.0)
        return _Moment(
            frame_index=frame_index,
            vectors=observations.vectors,
            state=state,
            actions=actions,
            distribution=distribution,
            values=values,
            final_values=self._final_values(raw, frames, step, after),
            step=step,
        )

    def _tensors(
        self,
        raw: Mapping[str, NDArray[Any]],
        state: Tensor,
        rows: NDArray[np.int64] | None = None,
    ) -> Observations:
        """Observations in all environments or some, with what is remembered before them (B, m)."""
        observations = to_tensors(raw, self._space, self._device, rows)
        if not self._policy.state_size:
            return observations
        return replace(observations, sequences=Sequences.single(state))

    def _final_values(
        self, raw: Mapping[str, NDArray[Any]], frames: _Frames, step: Step, state: Tensor
    ) -> Tensor:
        """Values (N,) of the last observations of episodes that were cut off; else zero.

        Args:
            raw: what was observed before the step.
            frames: with the features of that.
            step: what has just happened.
            state: (N, m) what is remembered after it.
        """
        values = torch.zeros(len(state), device=self._device)
        cut, final = np.flatnonzero(step.truncated), step.final_observations
        if not len(cut) or final is None:
            return values
        # With frame grab an episode's last image is its first, whose features are known.
        differ = frames_differ(final, raw, frames.names, cut)
        same, other = self._tensor(cut[~differ]), self._tensor(cut[differ])
        if len(same):
            vectors = self._tensors(frames.without(final), state[same], cut[~differ])
            values[same] = self._policy.value(vectors, frames.features.rows(same))
        if len(other):
            values[other] = self._policy.value(self._tensors(final, state[other], cut[differ]))
        return values

    def _sequences(self, moments: list[_Moment]) -> Tensor:
        """Numbers (M,) of the sequences that the transitions belong to."""
        done = np.stack([moment.step.done for moment in moments])
        return self._tensor(number_sequences(done, self._policy.sequence_length).ravel())

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self._device)

    def _estimate(
        self, moments: list[_Moment], last_values: Tensor, gamma: float, lambd: float
    ) -> tuple[Tensor, Tensor]:
        """Advantages and returns (T, N)."""

        def stack(name: str, dtype: torch.dtype) -> Tensor:
            array = np.stack([getattr(moment.step, name) for moment in moments])
            return torch.from_numpy(array).to(self._device, dtype)

        terminated, truncated = stack("terminated", torch.bool), stack("truncated", torch.bool)
        done = terminated | truncated
        values = torch.stack([moment.values for moment in moments])
        final_values = torch.stack([moment.final_values for moment in moments])
        following = torch.cat([values[1:], last_values[None]])
        rewards = stack("reward", values.dtype)
        if self._reward_normalizer is not None:
            rewards = self._reward_normalizer(rewards, done)
        return gae(
            rewards,
            values,
            torch.where(truncated, final_values, following),
            terminated,
            done,
            gamma=gamma,
            lambd=lambd,
        )


@dataclass(frozen=True)
class _Moment:
    """One step of N environments: tensors of leading length N, and what the environments said."""

    frame_index: Tensor
    vectors: dict[str, Tensor]
    state: Tensor
    actions: Tensor
    distribution: Distribution
    values: Tensor
    final_values: Tensor
    step: Step


class _Frames:
    """The frames of one collection, and the features of those in view.

    Attributes:
        names: the observations that are frames.
        new: the environments whose frame has not been looked at yet.
        features: of the frames in view.
    """

    def __init__(
        self, policy: ActorCritic, env_runner: EnvRunner, steps: int, device: torch.device
    ):
        self._policy, self._device = policy, device
        self._space = env_runner.env.single_observation_space
        self._count = env_runner.env.num_envs
        spaces = frame_spaces(self._space)
        self.names = frozenset(spaces)
        self._store = FrameStore(spaces, steps * self._count, device)
        self._index = np.zeros(self._count, np.int64)
        self.features = FrameFeatures(None, None)
        self.new = np.arange(self._count)

    def look(self, raw: Mapping[str, NDArray[Any]]) -> Tensor:
        """Keeps and encodes the new frames; returns everyone's index (N,).

        Without cameras every observation counts as a frame of its own.
        """
        if not self.names:
            self.new = np.arange(self._count)
        if len(self.new):
            self._index[self.new] = self._store.add(raw, self.new)
            if self.names:
                self._encode()
        return torch.from_numpy(self._index.copy()).to(self._device)

    def without(self, raw: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The observations that are not frames."""
        return {name: values for name, values in raw.items() if name not in self.names}

    def tensors(self) -> dict[str, Tensor]:
        """All frames by name, (U, H, W, C)."""
        return self._store.tensors()

    def _encode(self) -> None:
        latest = self._store.tensors(self._store.count - len(self.new))
        with timed("encode"):
            fresh = self._policy.encode_frames(Observations(latest, {}))
        if len(self.new) < self._count:
            rows = torch.from_numpy(self.new).to(self._device)
            fresh = self.features.with_rows(rows, fresh)
        self.features = fresh
