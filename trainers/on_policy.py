"""Collecting experience with the present policy, for PPO and its like."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainers.interaction import Interaction, Step
from trainers.observations import to_tensors
from trainers.policy import ActorCritic, FrameFeatures, to_environment
from trainers.returns import gae
from trainers.reward_normalizer import RewardNormalizer
from trainers.rollout import FrameStore, Rollout, frame_spaces
from trainers.timers import timed


class OnPolicyCollector:
    """Plays T steps in each of N environments with a policy that does not change meanwhile.

    Args:
        policy: draws the actions and values the observations.
        interaction: the environments.
        steps: T.
        generator: the source of the actions' randomness.
        device: where the policy lives.
        reward_normalizer: scales the rewards that are learned from; None: they stay as they are.
    """

    def __init__(
        self,
        policy: ActorCritic,
        interaction: Interaction,
        steps: int,
        generator: torch.Generator,
        device: torch.device,
        reward_normalizer: RewardNormalizer | None = None,
    ):
        self._policy, self._interaction, self._steps = policy, interaction, steps
        self._generator, self._device = generator, device
        self._reward_normalizer = reward_normalizer
        env = interaction.env
        self._space, self._action_space = env.single_observation_space, env.single_action_space

    @torch.no_grad()
    def collect(self, gamma: float, lambd: float) -> Rollout:
        """Plays, and works out advantages and returns.

        Raises:
            NonFiniteError: a reward or an observation is NaN or infinite.
        """
        frames = _Frames(self._policy, self._interaction, self._steps, self._device)
        moments = [self._play(frames) for _ in range(self._steps)]
        last = to_tensors(self._interaction.observations, self._space, self._device)
        advantages, returns = self._estimate(moments, self._policy.value(last), gamma, lambd)
        return Rollout(
            frames=frames.tensors(),
            frame_index=torch.cat([moment.frame_index for moment in moments]),
            vectors={
                name: torch.cat([moment.vectors[name] for moment in moments])
                for name in moments[0].vectors
            },
            actions=torch.cat([moment.actions for moment in moments]),
            log_probs=torch.cat([moment.log_probs for moment in moments]),
            values=torch.cat([moment.values for moment in moments]),
            advantages=advantages.flatten(),
            returns=returns.flatten(),
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly."""
        normalizer = self._reward_normalizer
        return {"reward_normalizer": None if normalizer is None else normalizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state."""
        if self._reward_normalizer is not None:
            self._reward_normalizer.load_state_dict(state["reward_normalizer"])

    def _play(self, frames: _Frames) -> _Moment:
        """Acts once in every environment."""
        raw = self._interaction.observations
        frame_index, features = frames.look(raw)
        with timed("act"):
            vectors = {name: values for name, values in raw.items() if name not in frames.names}
            observations = to_tensors(vectors, self._space, self._device)
            distribution, values = self._policy(observations, features)
            actions = distribution.sample(self._generator)
        step = self._interaction.step(to_environment(actions, self._action_space))
        frames.new = np.flatnonzero(~step.same_frame)
        return _Moment(
            frame_index=frame_index,
            vectors=observations.vectors,
            actions=actions,
            log_probs=distribution.log_prob(actions),
            values=values,
            final_values=self._final_values(step, values),
            step=step,
        )

    def _final_values(self, step: Step, like: Tensor) -> Tensor:
        """Values (N,) of the last observations of episodes that were cut off; else zero."""
        values = torch.zeros_like(like)
        rows = np.flatnonzero(step.truncated)
        if len(rows) and step.final_observations is not None:
            final = to_tensors(step.final_observations, self._space, self._device, rows)
            values[torch.from_numpy(rows).to(self._device)] = self._policy.value(final)
        return values

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
    actions: Tensor
    log_probs: Tensor
    values: Tensor
    final_values: Tensor
    step: Step


class _Frames:
    """The frames of one collection, and the features of those in view.

    Attributes:
        names: the observations that are frames.
        new: the environments whose frame has not been looked at yet.
    """

    def __init__(
        self, policy: ActorCritic, interaction: Interaction, steps: int, device: torch.device
    ):
        self._policy, self._device = policy, device
        self._space = interaction.env.single_observation_space
        self._count = interaction.env.num_envs
        spaces = frame_spaces(self._space)
        self.names = frozenset(spaces)
        self._store = FrameStore(spaces, steps * self._count)
        self._index = np.zeros(self._count, np.int64)
        self._features = FrameFeatures(None, None)
        self.new = np.arange(self._count)

    def look(self, raw: Mapping[str, NDArray[Any]]) -> tuple[Tensor, FrameFeatures]:
        """Keeps and encodes the new frames; returns everyone's index (N,) and features.

        Without cameras every observation counts as a frame of its own.
        """
        if not self.names:
            self.new = np.arange(self._count)
        if len(self.new):
            self._index[self.new] = self._store.add(raw, self.new)
            if self.names:
                self._encode(raw)
        return torch.from_numpy(self._index.copy()).to(self._device), self._features

    def tensors(self) -> dict[str, Tensor]:
        """All frames by name, (U, H, W, C)."""
        return self._store.tensors(self._device)

    def _encode(self, raw: Mapping[str, NDArray[Any]]) -> None:
        frames = {name: raw[name] for name in self.names}
        with timed("encode"):
            seen = to_tensors(frames, self._space, self._device, self.new)
            fresh = self._policy.encode_frames(seen)
        if len(self.new) < self._count:
            rows = torch.from_numpy(self.new).to(self._device)
            fresh = self._features.with_rows(rows, fresh)
        self._features = fresh
