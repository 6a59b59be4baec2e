"""Experience that is drawn again and again: a ring of transitions, each frame kept once.

Time runs through the rows of the ring, and a row holds one observation of each of N environments
and what came of the action taken there. The observation a transition leads to is thus the next
row's, kept once, except where an episode was cut off: its true last observation is kept aside.
Images are kept apart, in slots, and referred to; a slot is used anew when the last row that refers
to it is overwritten.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.memory import shortage, space_bytes
from trainers.common.errors import UserError
from trainers.experience.env_runner import Step
from trainers.networks.observations import Observations, frames_differ, is_frame

NONE = -1
BYTES_BESIDE = 38
"""Of a transition, next to its observations and its action."""
_FRAME = ""  # no observation has this name
_Kind = tuple[tuple[int, ...], np.dtype[Any]]
"""Shape and type of one entry."""


class ReplayBuffer:
    """The latest transitions of N environments.

    Transitions are named by *indices*, integers (B,) as `sample` draws them.

    Args:
        space: of one environment's observations.
        action_size: A, length of an action.
        num_envs: N.
        capacity: transitions kept, over all environments; rounded up to a multiple of N.
        device: of the tensors that are handed out; the experience itself is in main memory.

    Raises:
        UserError: there is no room for that many.
    """

    def __init__(
        self,
        space: gymnasium.spaces.Dict,
        action_size: int,
        num_envs: int,
        capacity: int,
        device: torch.device,
    ):
        self._num_envs, self._device = num_envs, device
        self._steps = -(-capacity // num_envs)
        self._rows = self._steps + 1  # one more, for the present observations
        size = self._rows * num_envs
        frames = {k: _kind(part) for k, part in space.spaces.items() if is_frame(part)}
        vectors = {k: _kind(part) for k, part in space.spaces.items() if not is_frame(part)}
        if lack := shortage(size * (space_bytes(space) + BYTES_BESIDE + 4 * action_size)):
            raise UserError(
                f"trainer.hyperparameters.buffer_size: to keep {capacity:,} transitions {lack}: "
                "lower it"
            )
        try:
            # Memory of zeros is given page by page when it is first written to, so that what
            # frames in common and unfinished episodes leave unused costs nothing.
            self._vectors = {k: np.zeros((size, *s), dtype) for k, (s, dtype) in vectors.items()}
            self._actions = np.zeros((size, action_size), np.float32)
            self._frames = _Slots(frames, 2 * size if frames else 0)
            self._finals = _Slots(vectors | {_FRAME: ((), np.dtype(np.int64))}, size)
        except MemoryError as error:
            raise UserError(
                f"trainer.hyperparameters.buffer_size: there is no room for {capacity} transitions "
                f"({error}): lower it"
            ) from error
        self._rewards = np.zeros(size, np.float32)
        self._terminated = np.zeros(size, bool)
        self._done = np.zeros(size, bool)
        self._frame = np.zeros(size, np.int64)  # slot of each observation's images
        self._final = np.full(size, NONE)  # slot of the last observation, where one was cut off
        self._row = 0  # of the present observations
        self._length = 0  # rows with a transition

    def __len__(self) -> int:
        return self._length * self._num_envs

    def add(
        self,
        observations: Mapping[str, NDArray[Any]],
        actions: NDArray[np.float32],
        step: Step,
        next_observations: Mapping[str, NDArray[Any]],
    ) -> None:
        """Keeps one transition of each environment, in place of the oldest ones.

        Args:
            observations: (N, ...) before the step; the next observations of the step added last.
            actions: (N, A).
            step: their result.
            next_observations: (N, ...) after the step, of new episodes where one ended.
        """
        here = self._row_indices(self._row)
        if not self._length:
            self._frame[here] = self._frames.add(observations, np.arange(self._num_envs))
            self._keep_vectors(here, observations)
        self._actions[here], self._rewards[here] = actions, step.reward
        self._terminated[here] = step.terminated
        self._done[here] = step.done
        self._keep_final(here, observations, step)
        self._row = (self._row + 1) % self._rows
        there = self._row_indices(self._row)
        if self._length == self._steps:
            self._release(there)
        else:
            self._length += 1
        self._keep_vectors(there, next_observations)
        new = np.flatnonzero(~step.same_frame)
        self._frame[there] = self._frame[here]
        self._frame[there][new] = self._frames.add(next_observations, new)

    def sample(self, count: int, generator: torch.Generator) -> NDArray[np.int64]:
        """Draws transitions, each as likely as any other: their indices (count,)."""
        drawn = torch.randint(
            len(self), (count,), generator=generator, device=generator.device
        ).cpu()
        oldest = (self._row - self._length) * self._num_envs
        indices: NDArray[np.int64] = (oldest + drawn.numpy()) % len(self._rewards)
        return indices

    def observations(self, indices: NDArray[np.int64], names: Collection[str]) -> Observations:
        """Observations before the transitions (B,), those of `names`."""
        vectors = {k: values[indices] for k, values in self._vectors.items() if k in names}
        return self._tensors(vectors, self._frame[indices], names)

    def actions(self, indices: NDArray[np.int64]) -> Tensor:
        """Actions (B, A)."""
        return self._to_device(self._actions[indices])

    def rewards(self, indices: NDArray[np.int64]) -> Tensor:
        """Rewards (B,)."""
        return self._to_device(self._rewards[indices])

    def returns(
        self, indices: NDArray[np.int64], gamma: float, steps: int
    ) -> tuple[Tensor, Tensor, NDArray[np.int64]]:
        """Returns of up to n steps, within the episode and within what is known.

        R = r_t + gamma r_t+1 + ... + gamma^(k-1) r_t+k-1, where k is n, or less where the episode
        ends or the newest transition is reached before.

        Args:
            indices: of the first transitions, (B,).
            gamma: discount per step.
            steps: n, at least 1.

        Returns:
            R (B,); the discount (B,) of the value of what follows: gamma^k, or 0 where the episode
            terminated; and the indices (B,) of the last transitions of the returns.
        """
        last, total = indices, self._rewards[indices]
        discount = np.full(len(indices), gamma, np.float32)
        for power in range(1, steps):
            next_indices = self._after(last)
            unknown = next_indices // self._num_envs == self._row
            goes_on = ~(self._done[last] | unknown)
            last = np.where(goes_on, next_indices, last)
            total[goes_on] += gamma**power * self._rewards[next_indices[goes_on]]
            discount[goes_on] *= gamma
        discount[self._terminated[last]] = 0.0
        return self._to_device(total), self._to_device(discount), last

    def next_observations(self, indices: NDArray[np.int64], names: Collection[str]) -> Observations:
        """Observations after the transitions (B,), those of `names`.

        Where an episode was cut off, its last ones; where it terminated, any, as none has a value.
        """
        next_indices = self._after(indices)
        vectors = {k: values[next_indices] for k, values in self._vectors.items() if k in names}
        frame, final = self._frame[next_indices], self._final[indices]
        cut = np.flatnonzero(final != NONE)
        if len(cut):
            kept = self._finals.gather(final[cut], (_FRAME, *vectors))
            frame[cut] = kept[_FRAME]
            for name, values in vectors.items():
                values[cut] = kept[name]
        return self._tensors(vectors, frame, names)

    def state_dict(self) -> dict[str, Any]:
        """All experience, without a copy: it holds until the next `add`."""
        rows = self._rows if self._length == self._steps else self._row + 1
        used = slice(rows * self._num_envs)
        return {
            "size": len(self._rewards),
            "row": self._row,
            "length": self._length,
            "fields": {name: array[used] for name, array in self._fields().items()},
            "vectors": {name: array[used] for name, array in self._vectors.items()},
            "frames": self._frames.state_dict(),
            "finals": self._finals.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state.

        Raises:
            ValueError: it is the state of a buffer of another size.
        """
        if state["size"] != len(self._rewards):
            raise ValueError("its replay buffer has another size: buffer_size must stay as it was")
        for arrays, saved in ((self._fields(), "fields"), (self._vectors, "vectors")):
            for name, array in arrays.items():
                array[: len(state[saved][name])] = state[saved][name]
        self._frames.load_state_dict(state["frames"])
        self._finals.load_state_dict(state["finals"])
        self._row, self._length = state["row"], state["length"]

    def _fields(self) -> dict[str, NDArray[Any]]:
        return {
            "actions": self._actions,
            "rewards": self._rewards,
            "terminated": self._terminated,
            "done": self._done,
            "frame": self._frame,
            "final": self._final,
        }

    def _row_indices(self, row: int) -> slice:
        row %= self._rows
        return slice(row * self._num_envs, (row + 1) * self._num_envs)

    def _after(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Indices of the next row."""
        next_indices: NDArray[np.int64] = (indices + self._num_envs) % len(self._rewards)
        return next_indices

    def _keep_vectors(self, indices: slice, observations: Mapping[str, NDArray[Any]]) -> None:
        for name, values in self._vectors.items():
            values[indices] = observations[name]

    def _keep_final(
        self, indices: slice, observations: Mapping[str, NDArray[Any]], step: Step
    ) -> None:
        """Keeps the last observations of episodes that were cut off; their images if they differ.

        What terminated has nothing after it that a learner could want to know the value of.
        """
        cut, final = np.flatnonzero(step.cut_off), step.final_observations
        self._final[indices] = NONE
        if not len(cut):
            return
        assert final is not None  # the env runner sees to it
        frame = self._frame[indices].copy()
        differ = frames_differ(final, observations, self._frames.names, cut)
        frame[cut[differ]] = self._frames.add(final, cut[differ])
        self._final[indices][cut] = self._finals.add({**final, _FRAME: frame}, cut)

    def _release(self, indices: slice) -> None:
        """Gives back the slots that nothing but a row's transitions refers to."""
        frame, final = self._frame[indices], self._final[indices]
        cut = np.flatnonzero(final != NONE)
        if len(cut):
            kept = self._finals.gather(final[cut], (_FRAME,))[_FRAME]
            self._frames.release(kept[kept != frame[cut]])
            self._finals.release(final[cut])
        next_frame = self._frame[self._row_indices(indices.start // self._num_envs + 1)]
        self._frames.release(frame[frame != next_frame])

    def _tensors(
        self,
        vectors: Mapping[str, NDArray[Any]],
        frame: NDArray[np.int64],
        names: Collection[str],
    ) -> Observations:
        tensors = {name: self._to_device(values) for name, values in vectors.items()}
        images = self._frames.names.intersection(names)
        if not images:
            return Observations({}, tensors)
        slots, index = np.unique(frame, return_inverse=True)
        frames = {k: self._to_device(v) for k, v in self._frames.gather(slots, images).items()}
        return Observations(frames, tensors, self._to_device(index))

    def _to_device(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self._device)


class _Slots:
    """Memory for entries that are kept and given back one by one.

    The slot given back last is used first, so that no more memory is ever touched than the most
    that was in use at a time.
    """

    def __init__(self, kinds: Mapping[str, _Kind], capacity: int):
        self._arrays = {name: np.zeros((capacity, *s), dtype) for name, (s, dtype) in kinds.items()}
        self._free = _descending(capacity)  # a stack, its top at the end
        self._left = capacity
        self._touched = 0
        self.names = frozenset(kinds)

    def add(self, values: Mapping[str, NDArray[Any]], rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Keeps some rows of the values; returns their slots."""
        if not self.names:
            return np.zeros(len(rows), np.int64)
        self._left -= len(rows)
        slots = self._free[self._left : self._left + len(rows)].copy()
        for name, array in self._arrays.items():
            array[slots] = values[name][rows]
        self._touched = max(self._touched, len(self._free) - self._left)
        return slots

    def gather(self, slots: NDArray[np.int64], names: Collection[str]) -> dict[str, NDArray[Any]]:
        """Copies of some entries, those of `names`."""
        return {name: self._arrays[name][slots] for name in names}

    def release(self, slots: NDArray[np.int64]) -> None:
        """Gives slots back."""
        if self.names:
            self._free[self._left : self._left + len(slots)] = slots
            self._left += len(slots)

    def state_dict(self) -> dict[str, Any]:
        """All entries, without a copy."""
        never_used = len(self._free) - self._touched
        return {
            "free": self._free[never_used : self._left],
            "entries": {name: array[: self._touched] for name, array in self._arrays.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state of slots of the same capacity."""
        for name, array in self._arrays.items():
            self._touched = len(state["entries"][name])
            array[: self._touched] = state["entries"][name]
        never_used = len(self._free) - self._touched
        self._left = never_used + len(state["free"])
        self._free[:never_used] = _descending(len(self._free))[:never_used]
        self._free[never_used : self._left] = state["free"]


def _kind(space: gymnasium.Space[Any]) -> _Kind:
    return space.shape or (), np.dtype(space.dtype)


def _descending(count: int) -> NDArray[np.int64]:
    return np.arange(count - 1, -1, -1)
