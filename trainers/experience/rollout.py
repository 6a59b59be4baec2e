"""Experience of a policy-gradient update: T steps of N environments, each frame kept once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from trainers.common.errors import UserError
from trainers.common.share import Share
from trainers.distributed.world import ALONE, World
from trainers.experience.returns import leave_one_out
from trainers.networks.observations import Observations, gather
from trainers.networks.recurrent import Sequences

POOLED_ROWS = ("hidden_states", "actions", "log_probs", "values", "advantages", "returns")
"""Fields of a rollout that are pooled as they are."""


class Minibatch(NamedTuple):
    """What one optimizer step learns from.

    Attributes:
        rows: (b,) one's own of the B transitions that the processes of a run learn from together.
        weight: b / B; of a process that has none of them 0, for a row that stands for none.
    """

    rows: Tensor
    weight: float

    @property
    def own_count(self) -> int:
        """Transitions of one's own."""
        return len(self.rows) if self.weight else 0


@dataclass(frozen=True)
class Rollout:
    """M transitions and their frames. Tensors have the leading axis M unless said otherwise.

    Attributes:
        share: whose transitions they are: T steps of n of N environments.
        frames: by name, (U, H, W, C).
        frame_index: which of the U frames belongs to each transition.
        vectors: by name, (M, n).
        shuffle_groups: the number, from 0, of the group that each belongs to, which stays
            together: the transitions of one frame or, of a policy with memory, of one sequence.
        all_groups: (T N,) the same of the transitions of all environments.
        hidden_states: (M, m) of the policy before each; m is 0 without memory.
        actions: as the policy drew them, before any squashing, scaling and clipping.
        log_probs: of the actions under the policy that drew them.
        values: under the critic of that time.
        advantages: see `trainers.experience.returns.gae`.
        returns: what the critic should have said.
        places: (T N,) of everyone's transitions, where they are `pooled`; None: one's own are here.
    """

    share: Share
    frames: dict[str, Tensor]
    frame_index: Tensor
    vectors: dict[str, Tensor]
    shuffle_groups: Tensor
    all_groups: Tensor
    hidden_states: Tensor
    actions: Tensor
    log_probs: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor
    places: Tensor | None = None

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
        """The sequences that some rows make up; None without memory."""
        if not self.hidden_states.shape[1]:
            return None
        _, lengths = self.shuffle_groups[rows].unique_consecutive(return_counts=True)
        first = rows[lengths.cumsum(0) - lengths]
        return Sequences(lengths.cpu(), self.hidden_states[first])

    def _frames_of(self, rows: Tensor) -> tuple[dict[str, Tensor], Tensor | None]:
        """The frames of some rows; where rows share them each once, and which is whose."""
        if not self.frames:
            return {}, None
        frames, index = self.frame_index[rows], None
        distinct, position = frames.unique(return_inverse=True)
        if len(distinct) < len(frames):
            frames, index = distinct, position
        return {name: gather(tensor, frames) for name, tensor in self.frames.items()}, index

    def against_other_tries(self, world: World = ALONE) -> Rollout:
        """The same, with advantages over the mean return of the other actions at each frame.

        Args:
            world: the processes of the run, which may have more tries than there are here.

        Raises:
            UserError: there are none; all of the processes say so.
        """
        if not world.any(len(self.frame_index.unique()) < len(self)):
            raise UserError(
                "trainer.hyperparameters.baseline: frame compares actions at the same frame, and "
                "every frame was acted on once: use images that stay for several actions "
                "(environment.frame_grab: true with episode_steps over 1), or baseline: critic"
            )
        return replace(self, advantages=leave_one_out(self.returns, self.frame_index))

    def in_shuffle_groups(self) -> Minibatch:
        """All transitions at once, those of one group side by side and in the order of time."""
        return self._own(self.all_groups.argsort(stable=True))

    def minibatches(self, size: int, generator: torch.Generator) -> Iterator[Minibatch]:
        """Splits all transitions at random into parts of `size`; the last may be smaller.

        Transitions of one group stay together, in the order of time: a frame is encoded once in a
        pass, and a sequence is cut at most where a part ends. Where every transition is a group of
        its own, this is a plain random split.
        """
        count = int(self.all_groups.max()) + 1
        device = self.all_groups.device
        place = torch.randperm(count, generator=generator, device=device)
        order = torch.argsort(place[self.all_groups], stable=True)
        for rows in order.split(size):
            yield self._own(rows)

    def _own(self, rows: Tensor) -> Minibatch:
        """What this process learns from of some transitions (B,) of all environments."""
        if self.places is None:
            return Minibatch(*self.share.own(rows))
        part = self.share.part(rows, self.all_groups[rows])
        some = part if len(part) else rows[:1]
        return Minibatch(self.places[some], len(part) / len(rows))

    def pooled(self, world: World) -> Rollout:
        """Everyone's transitions where memory is shared, else one's own; valid until the next pool.

        A minibatch has more transitions of some ranks' environments than of others', and in every
        optimizer step all would wait for who has most. From a pool each takes an equal part.
        """
        if not world.shares_memory or self.actions.device.type != "cpu":
            return self
        size, steps = world.size, len(self.all_groups) // self.share.total
        counts = world.gather(max(map(len, self.frames.values()), default=0))
        own = {name: getattr(self, name) for name in POOLED_ROWS}
        own["frame_index"] = self.frame_index + sum(counts[: world.rank])
        pool = iter(world.pool([*own.values(), *self.frames.values(), *self.vectors.values()]))
        # One rank's after the other's, by step, then by environment.
        places = torch.arange(len(self.all_groups)).view(size, steps, -1).transpose(0, 1).flatten()
        groups = torch.empty_like(self.all_groups)
        groups[places] = self.all_groups
        rows: dict[str, Any] = {name: next(pool) for name in own}
        frames = {name: next(pool) for name in self.frames}
        vectors = {name: next(pool) for name in self.vectors}
        return replace(
            self, **rows, frames=frames, vectors=vectors, shuffle_groups=groups, places=places
        )
