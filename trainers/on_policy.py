"""Collecting experience with the present policy, for PPO and its like."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainers.interaction import Interaction, Step
from trainers.observations import Observations, to_tensors
from trainers.policy import ActorCritic, FrameFeatures, to_environment
from trainers.returns import gae
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
    """

    def __init__(
        self,
        policy: ActorCritic,
        interaction: Interaction,
        steps: int,
        generator: torch.Generator,
        device: torch.device,
    ):
        self._policy, self._interaction, self._steps = policy, interaction, steps
        self._generator, self._device = generator, device
        env = interaction.env
        self._space, self._action_space = env.single_observation_space, env.single_action_space

    @torch.no_grad()
    def collect(self, gamma: float, lambd: float) -> Rollout:
        """Plays, and works out advantages and returns.

        Raises:
            NonFiniteError: a reward or an observation is NaN or infinite.
        """
        count = self._interaction.env.num_envs
        everyone = np.arange(count)
        images = frame_spaces(self._space)
        frames = FrameStore(images, self._steps * count if images else 0)
        frame_of = np.zeros(count, np.int64)
        new_frames = everyone
        features = FrameFeatures(None, None)
        columns: dict[str, list[Tensor]] = {}
        indices: list[NDArray[np.int64]] = []
        steps: list[Step] = []
        for _ in range(self._steps):
            raw = self._interaction.observations
            if images:
                frame_of[new_frames] = frames.add(raw, new_frames)
                with timed("encode"):
                    features = self._encode(features, raw, new_frames)
            else:
                frame_of = everyone + len(indices) * count
            with timed("act"):
                observations = self._vectors(raw)
                distribution, values = self._policy(observations, features)
                actions = distribution.sample(self._generator)
            step = self._interaction.step(to_environment(actions, self._action_space))
            row = {
                "actions": actions,
                "log_probs": distribution.log_prob(actions),
                "values": values,
                "final_values": self._final_values(step, values),
                **{f"vector {name}": vector for name, vector in observations.vectors.items()},
            }
            for name, value in row.items():
                columns.setdefault(name, []).append(value)
            indices.append(frame_of.copy())
            steps.append(step)
            new_frames = np.flatnonzero(~step.same_frame)
        last = to_tensors(self._interaction.observations, self._space, self._device)
        stacked = {name: torch.stack(values) for name, values in columns.items()}
        advantages, returns = self._estimate(stacked, steps, self._policy.value(last), gamma, lambd)
        flat = {name: tensor.flatten(0, 1) for name, tensor in stacked.items()}
        return Rollout(
            frames=frames.tensors(self._device),
            frame_index=torch.from_numpy(np.concatenate(indices)).to(self._device),
            vectors={
                name.removeprefix("vector "): tensor
                for name, tensor in flat.items()
                if name.startswith("vector ")
            },
            actions=flat["actions"],
            log_probs=flat["log_probs"],
            values=flat["values"],
            advantages=advantages.flatten(),
            returns=returns.flatten(),
        )

    def _encode(
        self, features: FrameFeatures, raw: Mapping[str, NDArray[Any]], rows: NDArray[np.int64]
    ) -> FrameFeatures:
        """The features of everyone's frames, given those from before and whose are new."""
        if not len(rows):
            return features
        fresh = self._policy.encode_frames(to_tensors(raw, self._space, self._device, rows))
        if len(rows) == len(next(iter(raw.values()))):
            return fresh
        return features.with_rows(torch.from_numpy(rows).to(self._device), fresh)

    def _vectors(self, raw: Mapping[str, NDArray[Any]]) -> Observations:
        """The observations without their frames, whose features are known."""
        images = frame_spaces(self._space)
        vectors = {name: values for name, values in raw.items() if name not in images}
        return to_tensors(vectors, self._space, self._device)

    def _final_values(self, step: Step, like: Tensor) -> Tensor:
        """Values (N,) of the last observations of episodes that were cut off; else zero."""
        values = torch.zeros_like(like)
        rows = np.flatnonzero(step.truncated)
        if len(rows) and step.final_observations is not None:
            final = to_tensors(step.final_observations, self._space, self._device, rows)
            values[torch.from_numpy(rows).to(self._device)] = self._policy.value(final)
        return values

    def _estimate(
        self,
        columns: dict[str, Tensor],
        steps: list[Step],
        last_values: Tensor,
        gamma: float,
        lambd: float,
    ) -> tuple[Tensor, Tensor]:
        def stack(name: str, dtype: torch.dtype) -> Tensor:
            array = np.stack([getattr(step, name) for step in steps])
            return torch.from_numpy(array).to(self._device, dtype)

        terminated, truncated = stack("terminated", torch.bool), stack("truncated", torch.bool)
        values = columns["values"]
        following = torch.cat([values[1:], last_values[None]])
        return gae(
            stack("reward", values.dtype),
            values,
            torch.where(truncated, columns["final_values"], following),
            terminated,
            terminated | truncated,
            gamma=gamma,
            lambd=lambd,
        )
