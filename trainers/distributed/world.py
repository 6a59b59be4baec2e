"""The processes of a run, which do together what one alone does.

Each has a share of the environments and all of the networks. What all of them need to know they
tell each other at the same points of the run; of one process alone it is what that has.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from trainers.common.averager import Averager
from trainers.common.command import told
from trainers.common.errors import Failure, NonFiniteError, UserError
from trainers.common.origin import is_told
from trainers.common.share import Share
from trainers.common.stopping import StopRequested
from trainers.distributed.states import Axes, differing, divided, joined, on_cpu

Value = TypeVar("Value")


class RankFailure(Failure):
    """Another process of the run failed; the message says which, and of what."""


class RankLostError(Failure):
    """Another process of the run is gone, and nothing can be exchanged any more."""


class World:
    """One process alone.

    Attributes:
        rank: number of this process, from 0. The first writes.
        size: k, how many there are.
        shares_memory: whether all of them can `pool`.
    """

    rank = 0
    size = 1
    shares_memory = False

    @property
    def writes(self) -> bool:
        """Whether the run's folder and the terminal are this process's to write."""
        return self.rank == 0

    def device(self, name: str) -> str:
        """Which device this process means by a name: of a machine's GPUs each has one."""
        return name

    def share(self, count: int) -> Share:
        """This process's share where each has `count` environments."""
        return Share(self.rank * count, count, self.size * count)

    def gather(self, value: Value) -> list[Value]:
        """Everyone's value, by rank; tensors in it are on the CPU."""
        return [value]

    def gather_to_first(self, value: Value) -> list[Value]:
        """As `gather`, of the first process; others have nothing."""
        return [value]

    def first(self, value: Value) -> Value:
        """The value of the first process; tensors in it are on the CPU."""
        return self.gather(value)[0]

    def all_know(self, error: BaseException) -> bool:
        """Whether all processes end by an error, at the same point of the run."""
        return True

    def any(self, condition: bool) -> bool:
        """Whether it is so for anyone."""
        return condition

    @contextmanager
    def together(self) -> Iterator[None]:
        """Ends what each process does by itself: if one is stopped or fails there, so are all.

        Raises:
            StopRequested: one was stopped.
            RankFailure: another one failed.
        """
        yield

    def mean(
        self, tensors: Sequence[Tensor], weight: float, *, stop: bool = False
    ) -> Sequence[Tensor]:
        """Means over everyone's transitions of what are means over one's own.

        Args:
            tensors: of the same shapes everywhere.
            weight: the share of all transitions that one's own are; 1 where there are no others.
            stop: whether the run should stop, as far as this process knows.

        Raises:
            StopRequested: one process says so.
        """
        if stop:
            raise StopRequested
        return tensors

    def all_rows(self, rows: Tensor, count: int) -> Tensor:
        """Everyone's (T N, ...) where one's own are (T n, ...): by step, then by environment.

        Args:
            rows: one's own.
            count: n environments.
        """
        return rows

    def pool(self, tensors: Sequence[Tensor]) -> Sequence[Tensor]:
        """Everyone's (sum of n, ...), one rank's after the other's, in memory that all read.

        Args:
            tensors: (n, ...) one's own, on the CPU. What they become is valid until the next call.
        """
        return tensors

    def all_groups(self, groups: Tensor, count: int) -> Tensor:
        """Everyone's groups (T N,), as `all_rows`; numbered in the order in which they come first.

        Args:
            groups: (T n,) one's own, numbered like that.
            count: n environments.
        """
        return groups

    def means(self, averager: Averager) -> dict[str, float]:
        """Means over what everyone added; an averager begins anew with it."""
        return averager.pop_means()

    def state(self, state: Mapping[str, Any], axes: Axes) -> Mapping[str, Any]:
        """The state that one process alone would have; see `states.joined`.

        The first process's, which writes it; others have nothing of it.
        """
        return state

    def own(self, state: Mapping[str, Any], axes: Axes, share: Share) -> Mapping[str, Any]:
        """This process's share of such a state; see `states.divided`."""
        return state

    def check_same(self, what: str, content: str) -> None:
        """Sees to it that all processes were given the same.

        Raises:
            UserError: names those that were given something else than the first.
        """


class Ranks(World):
    """One of k processes. How they exchange values is the subclass's affair."""

    def __init__(self, rank: int, size: int):
        self.rank, self.size = rank, size
        self._told: BaseException | None = None

    def sum(self, parts: Sequence[Tensor], weight: float) -> Tensor:
        """Sums (n,) of everyone's parts, one after the other; the same to the last bit everywhere.

        Args:
            parts: vectors of the same kind.
            weight: of one's own.
        """
        raise NotImplementedError

    def gather_to_first(self, value: Value) -> list[Value]:
        """See `World.gather_to_first`."""
        raise NotImplementedError

    def first(self, value: Value) -> Value:
        """See `World.first`: only that one is sent."""
        return self.gather(value if self.writes else cast(Value, None))[0]

    def name(self, rank: int) -> str:
        """A process, for people."""
        return f"rank {rank}"

    def all_know(self, error: BaseException) -> bool:
        """See `World.all_know`; what is not finite is so for all of them."""
        return error is self._told or isinstance(error, RankFailure | NonFiniteError)

    def any(self, condition: bool) -> bool:
        """See `World.any`."""
        return self.sum([torch.tensor([float(condition)])], 1.0).item() > 0

    @contextmanager
    def together(self) -> Iterator[None]:
        """See `World.together`."""
        own: BaseException | None = None
        try:
            yield
        except (StopRequested, Exception, SystemExit) as error:
            own = error
        stops = isinstance(own, StopRequested)
        ends = self.gather((stops, None if own is None or stops else _reason(own)))
        reasons = [reason for _, reason in ends]
        failed = [rank for rank, reason in enumerate(reasons) if reason is not None]
        # A mistake that all of them made is the first one's to tell.
        if own is not None and self.rank in failed and reasons.index(_reason(own)) == self.rank:
            self._told = own
            raise own
        if failed:
            raise RankFailure(f"{self.name(failed[0])}: {reasons[failed[0]]}") from own
        if any(stopped for stopped, _ in ends):
            raise StopRequested

    def mean(
        self, tensors: Sequence[Tensor], weight: float, *, stop: bool = False
    ) -> Sequence[Tensor]:
        """See `World.mean`; all go in one flat vector, and the wish to stop with them."""
        parts = [tensor.detach().reshape(-1) for tensor in tensors]
        # Of who weighs nothing it is heard at the next mean.
        parts.append(parts[0].new_full((1,), float(stop)))
        *sums, stops = self.sum(parts, weight).split([len(part) for part in parts])
        if stops.item() > 0:
            raise StopRequested
        return [part.view_as(own) for part, own in zip(sums, tensors, strict=True)]

    def all_rows(self, rows: Tensor, count: int) -> Tensor:
        """See `World.all_rows`."""
        parts = self.gather(rows.cpu())
        by_step = [part.unflatten(0, (-1, count)) for part in parts]
        return torch.cat(by_step, dim=1).flatten(0, 1).to(rows.device)

    def all_groups(self, groups: Tensor, count: int) -> Tensor:
        """See `World.all_groups`."""
        # Apart from each other first: no rank has as many groups as transitions of all ranks.
        apart = self.all_rows(groups + self.rank * self.size * len(groups), count)
        _, first, number = np.unique(apart.cpu().numpy(), return_index=True, return_inverse=True)
        numbers = np.empty_like(first)
        numbers[np.argsort(first)] = np.arange(len(first))
        return torch.from_numpy(numbers[number]).to(groups.device)

    def means(self, averager: Averager) -> dict[str, float]:
        """See `World.means`."""
        everyone = Averager()
        for part in self.gather(averager.state_dict()):
            everyone.add_sums(part)
        averager.pop_means()
        return everyone.means()

    def state(self, state: Mapping[str, Any], axes: Axes) -> Mapping[str, Any]:
        """See `World.state`."""
        # What is alike everywhere, as an optimizer's, is told by the first alone.
        own = on_cpu(differing(state, axes) if self.rank else state)
        states = self.gather_to_first(own)
        return joined(states, axes) if self.writes else {}

    def own(self, state: Mapping[str, Any], axes: Axes, share: Share) -> Mapping[str, Any]:
        """See `World.own`."""
        return divided(state, axes, share)

    def check_same(self, what: str, content: str) -> None:
        """See `World.check_same`."""
        digests = self.gather(hashlib.sha256(content.encode()).hexdigest())
        others = [self.name(rank) for rank, one in enumerate(digests) if one != digests[0]]
        if others:
            raise UserError(
                f"{what}: that of {', '.join(others)} is another than that of {self.name(0)}: "
                "start all of them with the same"
            )


ALONE = World()


def _reason(error: BaseException) -> str:
    """Why a process failed, in a line."""
    if is_told(error):
        return told(error)
    return f"{type(error).__name__}: {error}".removesuffix(": ")
