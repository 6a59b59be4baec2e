"""Experience of a policy-gradient update: T steps of N environments, each frame kept once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainers.networks.observations import Observations, gather, is_frame
from trainers.networks.recurrent import Sequences


class FrameStore:
    """Frames in the order they came, each once, and moved to the device once.

    The memory is reserved for the most there can be; on the CPU the operating system gives it page
    by page as frames arrive, so that frames which are shared cost nothing.

    Args:
        spaces: of the frames, by name.
        capacity: the most frames there can be.
        device: where they are kept.
    """

    def __init__(
        self,
        spaces: Mapping[str, gymnasium.Space[Any]],
        capacity: int,
        device: torch.device,
    ):
        self._tensors = {
            name: torch.empty((capacity, *(space.shape or ())), dtype=_dtype(space), device=device)
            for name, space in spaces.items()
        }
        self.count = 0

    def add(
        self, observations: Mapping[str, NDArray[Any]], rows: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Keeps some rows of the observations; returns the frames' indices."""
        first, self.count = self.count, self.count + len(rows)
        for name, tensor in self._tensors.items():
            tensor[first : self.count].copy_(torch.from_numpy(observations[name][rows]))
        return np.arange(first, self.count)

    def tensors(self, first: int = 0) -> dict[str, Tensor]:
        """All frames from the `first` on by name, (count - first, H, W, C), without a copy."""
        return {name: tensor[first : self.count] for name, tensor in self._tensors.items()}


@dataclass(frozen=True)
class Rollout:
    """M transitions and their frames. Tensors have the leading axis M unless said otherwise.

    Attributes:
        frames: by name, (U, H, W, C).
        frame_index: which of the U frames belongs to each transition.
        vectors: by name, (M, n).
        shuffle_groups: the number, from 0, of the group that each belongs to, which stays
            together: the transitions of one frame or, of a policy with memory, of one sequence.
        states: (M, m) what the policy remembered before each; m is 0 without memory.
        actions: as the policy drew them, before any clipping.
        log_probs: of the actions under the policy that drew them.
        values: under the critic of that time.
        advantages: see `trainers.experience.returns.gae`.
        returns: what the critic should have said.
    """

    frames: dict[str, Tensor]
    frame_index: Tensor
    vectors: dict[str, Tensor]
    shuffle_groups: Tensor
    states: Tensor
    actions: Tensor
    log_probs: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor

    def __len__(self) -> int:
        return len(self.actions)

    def observations(self, rows: Tensor) -> Observations:
        """Observations of some transitions, with the frames they share once.

        Args:
            rows: (B,) in an order that `minibatches` or `in_shuffle_groups` gives.
        """
        chosen, index = self._frames_of(rows)
        vectors = {name: values[rows] for name, values in self.vectors.items()}
        return Observations(chosen, vectors, index, self._sequences_of(rows))

    def _sequences_of(self, rows: Tensor) -> Sequences | None:
        """The sequences that some rows make up; None where nothing is remembered."""
        if not self.states.shape[1]:
            return None
        _, lengths = self.shuffle_groups[rows].unique_consecutive(return_counts=True)
        first = rows[lengths.cumsum(0) - lengths]
        return Sequences(lengths.cpu(), self.states[first])

    def _frames_of(self, rows: Tensor) -> tuple[dict[str, Tensor], Tensor | None]:
        """The frames of some rows; where rows share them each once, and which is whose."""
        if not self.frames:
            return {}, None
        frames, index = self.frame_index[rows], None
        distinct, place = frames.unique(return_inverse=True)
        if len(distinct) < len(frames):
            frames, index = distinct, place
        return {name: gather(tensor, frames) for name, tensor in self.frames.items()}, index

    def in_shuffle_groups(self) -> Tensor:
        """All rows (M,), those of one group side by side and in the order of time."""
        return self.shuffle_groups.argsort(stable=True)

    def minibatches(self, size: int, generator: torch.Generator) -> Iterator[Tensor]:
        """Splits all transitions at random into parts of `size` rows; the last may be smaller.

        Transitions of one group stay together, in the order of time: a frame is encoded once in a
        pass, and a sequence is cut at most where a part ends. Where every transition is a group of
        its own, this is a plain random split.
        """
        count = int(self.shuffle_groups.max()) + 1
        device = self.shuffle_groups.device
        place = torch.randperm(count, generator=generator, device=device)
        order = torch.argsort(place[self.shuffle_groups], stable=True)
        yield from order.split(size)


def frame_spaces(space: gymnasium.spaces.Dict) -> dict[str, gymnasium.Space[Any]]:
    """The spaces of the images among the observations."""
    return {name: part for name, part in space.spaces.items() if is_frame(part)}


def _dtype(space: gymnasium.Space[Any]) -> torch.dtype:
    """Torch's name of the type of a space's numbers."""
    return torch.from_numpy(np.empty(0, space.dtype)).dtype
