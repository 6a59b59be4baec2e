"""Collection in N environments: frames encoded once, hidden states carried from step to step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainers.common.timers import timed
from trainers.experience.env_runner import EnvRunner, Step
from trainers.experience.frames import FrameStore, frame_spaces
from trainers.networks.actions import to_environment
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.observations import Observations, to_tensors
from trainers.networks.recurrent import Sequences

Output = TypeVar("Output")


@dataclass(frozen=True)
class BehaviorOutput(Generic[Output]):
    """Actions at N observations, and what comes with them.

    Attributes:
        actions: (N, ...) in the units of the environment's space.
        hidden_state: (N, m) after the observations.
        output: whatever else learning needs of that step.
    """

    actions: Tensor
    hidden_state: Tensor
    output: Output


class Behavior(Protocol[Output]):
    """An algorithm's way of acting while it collects experience.

    Attributes:
        state_size: m, length of the hidden state; 0 without memory.
    """

    state_size: int

    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """Features of U frames by name, (U, H, W, C)."""

    def act(self, observations: Observations, features: FrameFeatures) -> BehaviorOutput[Output]:
        """Actions at N observations, whose frames are known by their features alone."""


@dataclass(frozen=True)
class CollectedStep(Generic[Output]):
    """One step of N environments.

    Attributes:
        observations: (N, ...) before the step, as the environments gave them.
        next_observations: (N, ...) after it; where an episode ended, the first of the next one.
        frame_index: (N,) in the store, of the frame that each environment shows before the step.
        features: of the frames in view before the step.
        vectors: (N, n) by name, before the step.
        hidden_state: (N, m) before the observations.
        acted: the actions, with what the behavior gave beside them.
        step: what came of the actions.
    """

    observations: Mapping[str, NDArray[Any]]
    next_observations: Mapping[str, NDArray[Any]]
    frame_index: Tensor
    features: FrameFeatures
    vectors: dict[str, Tensor]
    hidden_state: Tensor
    acted: BehaviorOutput[Output]
    step: Step


class Collector(Generic[Output]):
    """Steps the environments, and encodes each frame once as long as the weights stay as they are.

    Hidden states of running episodes are carried from one collection to the next.

    Args:
        behavior: chooses the actions.
        env_runner: the environments.
        device: where the policy lives.

    Attributes:
        hidden_state: (N, m) before the present observations.
        frame_names: of the observations that are frames.
    """

    def __init__(self, behavior: Behavior[Output], env_runner: EnvRunner, device: torch.device):
        self._behavior, self._env_runner, self._device = behavior, env_runner, device
        env = env_runner.env
        self._space, self._action_space = env.single_observation_space, env.single_action_space
        self._frame_spaces = frame_spaces(self._space)
        self.frame_names = frozenset(self._frame_spaces)
        self._everyone = np.arange(env.num_envs)
        self._frame_index = np.zeros(env.num_envs, np.int64)
        self._features = FrameFeatures()
        self._new = self._everyone
        self.hidden_state = torch.zeros(env.num_envs, behavior.state_size, device=device)

    def frame_store(self, steps: int) -> FrameStore:
        """Room for the frames of so many steps."""
        return FrameStore(self._frame_spaces, steps * len(self._everyone), self._device)

    def begin(self) -> None:
        """Forgets all features, because the weights may have changed."""
        self._new = self._everyone

    def collect_step(self, frames: FrameStore) -> CollectedStep[Output]:
        """Acts once in every environment.

        Args:
            frames: where new frames are kept.

        Raises:
            StopRequested: the run is to stop; nothing was done.
            NonFiniteError: a reward or an observation is NaN or infinite.
        """
        observations, hidden_state = self._env_runner.observations, self.hidden_state
        frame_index = self._encode_new_frames(observations, frames)
        features = self._features
        with timed("act"):
            vectors = self.to_tensors(self.without_frames(observations), hidden_state)
            acted = self._behavior.act(vectors, features)
        step = self._env_runner.step(to_environment(acted.actions, self._action_space))
        self._new = np.flatnonzero(~step.same_frame)
        if self._behavior.state_size:
            done = torch.from_numpy(step.done).to(self._device)
            self.hidden_state = acted.hidden_state.masked_fill(done[:, None], 0.0)
        return CollectedStep(
            observations,
            self._env_runner.observations,
            frame_index,
            features,
            vectors.vectors,
            hidden_state,
            acted,
            step,
        )

    def to_tensors(
        self,
        observations: Mapping[str, NDArray[Any]],
        hidden_state: Tensor,
        rows: NDArray[np.int64] | None = None,
    ) -> Observations:
        """Observations in all environments or some, with the hidden states before them (B, m)."""
        tensors = to_tensors(observations, self._space, self._device, rows)
        if not self._behavior.state_size:
            return tensors
        return replace(tensors, sequences=Sequences.single(hidden_state))

    def without_frames(self, observations: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The observations that are not frames."""
        return {k: values for k, values in observations.items() if k not in self.frame_names}

    def _encode_new_frames(
        self, observations: Mapping[str, NDArray[Any]], frames: FrameStore
    ) -> Tensor:
        """Keeps and encodes the frames that came into view; returns everyone's index (N,).

        Without images every observation counts as a frame of its own.
        """
        new = self._new if self.frame_names else self._everyone
        if len(new):
            first = frames.count
            self._frame_index[new] = frames.add(observations, new)
            if self.frame_names:
                with timed("encode"):
                    fresh = self._behavior.encode_frames(frames.tensors(first))
                if len(new) < len(self._everyone):
                    rows = torch.from_numpy(new).to(self._device)
                    fresh = self._features.with_rows(rows, fresh)
                self._features = fresh
        return torch.from_numpy(self._frame_index.copy()).to(self._device)
