"""Experience that is drawn again and again: a ring of transitions, each frame kept once.

Time runs through the rows of the ring, and a row holds one observation of each of N environments
and what came of the action taken there. The observation a transition leads to is thus the next
row's, kept once, except where an episode was cut off: its true last observation is kept aside.
Images are kept apart, in slots, and referred to; a slot is used anew when the last row that refers
to it is overwritten.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.memory import shortage, space_bytes
from trainers.common.errors import UserError
from trainers.experience.env_runner import Step
from trainers.networks.observations import (
    Observations,
    frames_differ,
    gather,
    is_frame,
    scatter,
    torch_dtype,
    where,
)

NONE = -1
BYTES_BESIDE = 38
"""Of a transition, next to its observations and its action."""
_FRAME = ""  # no observation has this name
_FLOAT, _INTEGER, _BOOLEAN = map(np.dtype, (np.float32, np.int64, np.bool_))
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
        device: where the experience is kept, and handed out; on an accelerator nothing of it moves
            when it is drawn, and no shape depends on what is drawn.

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
        self._num_envs = num_envs
        self._steps = -(-capacity // num_envs)
        self._rows = self._steps + 1  # one more, for the present observations
        size = self._rows * num_envs
        frames = {k: _kind(part) for k, part in space.spaces.items() if is_frame(part)}
        vectors = {k: _kind(part) for k, part in space.spaces.items() if not is_frame(part)}
        needed_bytes = size * (space_bytes(space) + BYTES_BESIDE + 4 * action_size)
        if lack := shortage(needed_bytes, "replay buffer"):
            raise UserError(
                f"trainer.hyperparameters.buffer_size: to keep {capacity:,} transitions {lack}: "
                "lower it"
            )
        try:
            self._vectors = {k: _zeros((size, *s), d, device) for k, (s, d) in vectors.items()}
            self._actions = _zeros((size, action_size), _FLOAT, device)
            self._frames = _Slots(frames, 2 * size if frames else 0, device)
            self._finals = _Slots(vectors | {_FRAME: ((), _INTEGER)}, size, device)
        except (MemoryError, torch.OutOfMemoryError) as error:
            raise UserError(
                f"trainer.hyperparameters.buffer_size: there is no room for {capacity} transitions "
                f"({error}): lower it"
            ) from error
        self._rewards = _zeros((size,), _FLOAT, device)
        self._terminated = _zeros((size,), _BOOLEAN, device)
        self._done = _zeros((size,), _BOOLEAN, device)
        # Slots of each observation's images, and of the last observation where one was cut off:
        # for the books and, which on the CPU is the same memory, for what is drawn.
        self._frame, self._final = np.zeros(size, np.int64), np.full(size, NONE)
        self._frame_slots = torch.from_numpy(self._frame).to(device)
        self._final_slots = torch.from_numpy(self._final).to(device)
        self._row = 0  # of the present observations
        self._present = torch.zeros((), dtype=torch.int64, device=device)  # the same
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
            self._keep_frames(here, self._frames.add(observations, np.arange(self._num_envs)))
            self._keep_vectors(here, observations)
        self._actions[here] = torch.from_numpy(actions)
        self._rewards[here] = torch.from_numpy(step.reward)
        self._terminated[here] = torch.from_numpy(step.terminated)
        self._done[here] = torch.from_numpy(step.done)
        self._keep_final(here, observations, step)
        self._row = (self._row + 1) % self._rows
        self._present.fill_(self._row)
        there = self._row_indices(self._row)
        if self._length == self._steps:
            self._release(there)
        else:
            self._length += 1
        self._keep_vectors(there, next_observations)
        new, frame = np.flatnonzero(~step.same_frame), self._frame[here].copy()
        frame[new] = self._frames.add(next_observations, new)
        self._keep_frames(there, frame)
        self._final_slots[here] = torch.from_numpy(self._final[here])

    def sample(
        self, shape: tuple[int, ...], generator: torch.Generator, num_envs: int | None = None
    ) -> Tensor:
        """Draws transitions, each as likely as any other: their indices.

        Args:
            shape: of the indices.
            generator: the source of randomness.
            num_envs: N of a larger buffer of which this one is a share, and whose indices these are
                (see `Share.own`).
        """
        count = self._num_envs if num_envs is None else num_envs
        known = self._length * count
        drawn = torch.randint(known, shape, generator=generator, device=generator.device)
        oldest = (self._row - self._length) * count
        return (oldest + drawn) % (self._rows * count)

    def observations(self, indices: Tensor, names: Collection[str]) -> Observations:
        """Observations before the transitions (B,), those of `names`."""
        vectors = {k: gather(v, indices) for k, v in self._vectors.items() if k in names}
        return self._with_frames(vectors, self._frame_slots[indices], names)

    def actions(self, indices: Tensor) -> Tensor:
        """Actions (B, A)."""
        return self._actions[indices]

    def rewards(self, indices: Tensor) -> Tensor:
        """Rewards (B,)."""
        return self._rewards[indices]

    def returns(self, indices: Tensor, gamma: float, steps: int) -> tuple[Tensor, Tensor, Tensor]:
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
        discount = torch.full_like(total, gamma)
        for power in range(1, steps):
            next_indices = self._after(last)
            unknown = next_indices // self._num_envs == self._present
            goes_on = ~(self._done[last] | unknown)
            last = torch.where(goes_on, next_indices, last)
            total += torch.where(goes_on, gamma**power * self._rewards[next_indices], 0.0)
            discount = torch.where(goes_on, gamma * discount, discount)
        return total, discount.masked_fill(self._terminated[last], 0.0), last

    def next_observations(self, indices: Tensor, names: Collection[str]) -> Observations:
        """Observations after the transitions (B,), those of `names`.

        Where an episode was cut off, its last ones; where it terminated, any, as none has a value.
        """
        next_indices, final = self._after(indices), self._final_slots[indices]
        cut = final != NONE
        wanted = [name for name in self._vectors if name in names]
        kept = self._finals.gather(final.clamp(min=0), (_FRAME, *wanted))
        frame = where(cut, kept[_FRAME], self._frame_slots[next_indices])
        vectors = {k: where(cut, kept[k], gather(self._vectors[k], next_indices)) for k in wanted}
        return self._with_frames(vectors, frame, names)

    def state_dict(self) -> dict[str, Any]:
        """All experience: on the CPU without a copy, so that it holds until the next `add`."""
        rows = self._rows if self._length == self._steps else self._row + 1
        used = slice(rows * self._num_envs)
        return {
            "size": len(self._rewards),
            "row": self._row,
            "length": self._length,
            "fields": {name: _array(values[used]) for name, values in self._fields().items()},
            "vectors": {name: _array(values[used]) for name, values in self._vectors.items()},
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
            for name, tensor in arrays.items():
                tensor[: len(state[saved][name])] = torch.from_numpy(state[saved][name])
        self._frames.load_state_dict(state["frames"])
        self._finals.load_state_dict(state["finals"])
        for books, slots in ((self._frame, self._frame_slots), (self._final, self._final_slots)):
            books[:] = _array(slots)
        self._row, self._length = state["row"], state["length"]
        self._present.fill_(self._row)

    def _fields(self) -> dict[str, Tensor]:
        return {
            "actions": self._actions,
            "rewards": self._rewards,
            "terminated": self._terminated,
            "done": self._done,
            "frame": self._frame_slots,
            "final": self._final_slots,
        }

    def _row_indices(self, row: int) -> slice:
        row %= self._rows
        return slice(row * self._num_envs, (row + 1) * self._num_envs)

    def _after(self, indices: Tensor) -> Tensor:
        """Indices of the next row."""
        return (indices + self._num_envs) % len(self._rewards)

    def _keep_frames(self, indices: slice, slots: NDArray[np.int64]) -> None:
        self._frame[indices] = slots
        self._frame_slots[indices] = torch.from_numpy(slots)

    def _keep_vectors(self, indices: slice, observations: Mapping[str, NDArray[Any]]) -> None:
        for name, values in self._vectors.items():
            values[indices] = torch.from_numpy(np.ascontiguousarray(observations[name]))

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
            kept = _array(self._finals.gather(torch.from_numpy(final[cut]), (_FRAME,))[_FRAME])
            self._frames.release(kept[kept != frame[cut]])
            self._finals.release(final[cut])
        next_frame = self._frame[self._row_indices(indices.start // self._num_envs + 1)]
        self._frames.release(frame[frame != next_frame])

    def _with_frames(
        self, vectors: dict[str, Tensor], slots: Tensor, names: Collection[str]
    ) -> Observations:
        return Observations(
            self._frames.gather(slots, self._frames.names.intersection(names)), vectors
        )


class _Slots:
    """Memory for entries that are kept and given back one by one.

    The slot given back last is used first, so that no more memory is ever touched than the most
    that was in use at a time.
    """

    def __init__(self, kinds: Mapping[str, _Kind], capacity: int, device: torch.device):
        self._tensors = {k: _zeros((capacity, *s), d, device) for k, (s, d) in kinds.items()}
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
        for name, tensor in self._tensors.items():
            scatter(tensor, torch.from_numpy(slots), torch.from_numpy(values[name][rows]))
        self._touched = max(self._touched, len(self._free) - self._left)
        return slots

    def gather(self, slots: Tensor, names: Iterable[str]) -> dict[str, Tensor]:
        """Copies of some entries, those of `names`; the slots may lie on the CPU."""
        tensors = {name: self._tensors[name] for name in names}
        return {name: gather(tensor, slots.to(tensor.device)) for name, tensor in tensors.items()}

    def release(self, slots: NDArray[np.int64]) -> None:
        """Gives slots back."""
        if self.names:
            self._free[self._left : self._left + len(slots)] = slots
            self._left += len(slots)

    def state_dict(self) -> dict[str, Any]:
        """All entries, on the CPU without a copy."""
        never_used = len(self._free) - self._touched
        return {
            "free": self._free[never_used : self._left],
            "entries": {k: _array(tensor[: self._touched]) for k, tensor in self._tensors.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state of slots of the same capacity."""
        for name, tensor in self._tensors.items():
            self._touched = len(state["entries"][name])
            tensor[: self._touched].copy_(torch.from_numpy(state["entries"][name]))
        never_used = len(self._free) - self._touched
        self._left = never_used + len(state["free"])
        self._free[:never_used] = _descending(len(self._free))[:never_used]
        self._free[never_used : self._left] = state["free"]


def _zeros(shape: tuple[int, ...], dtype: np.dtype[Any], device: torch.device) -> Tensor:
    """Zeros; numpy's, on the CPU.

    Memory of those is given page by page when it is first written to, so that what frames in common
    and unfinished episodes leave unused costs nothing.
    """
    if device.type == "cpu":
        return torch.from_numpy(np.zeros(shape, dtype))
    return torch.zeros(shape, dtype=torch_dtype(dtype), device=device)


def _array(tensor: Tensor) -> NDArray[Any]:
    """The same numbers; on the CPU in the same memory."""
    array: NDArray[Any] = tensor.cpu().numpy()
    return array


def _kind(space: gymnasium.Space[Any]) -> _Kind:
    return space.shape or (), np.dtype(space.dtype)


def _descending(count: int) -> NDArray[np.int64]:
    return np.arange(count - 1, -1, -1)
