"""Processes that torchrun started, connected by torch.distributed."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from trainers.common.errors import first_lines
from trainers.common.timers import timed
from trainers.distributed import shared_memory
from trainers.distributed.shared_memory import SharedMemory, connected_sockets
from trainers.distributed.world import ALONE, RankLostError, Ranks, World

TIMEOUT_S = 600.0
"""To wait for the others: one that has not come by then hangs."""
ROLL_CALL_S = 5.0
"""For those that are left to say so, once one is gone."""

Value = TypeVar("Value")


class Processes(Ranks):
    """One of k processes. A lost one ends the others, with its name."""

    def __init__(self) -> None:
        super().__init__(dist.get_rank(), dist.get_world_size())
        self._store = dist.distributed_c10d._get_default_store()
        self._memory: SharedMemory | None = None
        self._names = [f"rank {rank}" for rank in range(self.size)]
        self._names = self.gather(f"rank {self.rank} ({socket.gethostname()}, {os.getpid()})")
        self._memory = self._shared() if shared_memory.is_possible() else None

    @property
    def shares_memory(self) -> bool:  # type: ignore[override]
        """See `World`."""
        return self._memory is not None

    def name(self, rank: int) -> str:
        """See `Ranks.name`: with its machine and the process's number."""
        return self._names[rank]

    def device(self, name: str) -> str:
        """See `World.device`."""
        return f"cuda:{os.environ['LOCAL_RANK']}" if name == "cuda" else name

    def gather(self, value: Value) -> list[Value]:
        """See `World.gather`."""
        with timed("gather"), self._naming_the_lost():
            if self._memory is not None:
                return self._memory.gather(value)
            values: list[Any] = [None] * self.size
            dist.all_gather_object(values, value)
            return values

    def gather_to_first(self, value: Value) -> list[Value]:
        """See `World.gather_to_first`."""
        with timed("gather"), self._naming_the_lost():
            if self._memory is not None:
                return self._memory.gather(value, to_first=True)
            values: list[Any] | None = [None] * self.size if self.writes else None
            dist.gather_object(value, values)
            return values or []

    def sum(self, parts: Sequence[Tensor], weight: float) -> Tensor:
        """See `Ranks.sum`."""
        with timed("all_reduce"), self._naming_the_lost():
            if self._memory is not None and not parts[0].is_cuda:
                return self._memory.sum(parts, weight)
            values = torch.cat([*parts]).mul_(weight)
            dist.all_reduce(values)
            return values

    def pool(self, tensors: Sequence[Tensor]) -> Sequence[Tensor]:
        """See `World.pool`."""
        assert self._memory is not None  # or it is not asked
        with timed("gather"), self._naming_the_lost():
            return self._memory.pool(tensors)

    def _shared(self) -> SharedMemory:
        with self._naming_the_lost():
            peers = connected_sockets(self.rank, self.size, self.first, TIMEOUT_S)
        return SharedMemory(self.rank, self.size, peers)

    @contextmanager
    def _naming_the_lost(self) -> Iterator[None]:
        """Says who is missing where an exchange fails.

        Raises:
            RankLostError: it did.
        """
        try:
            yield
        except (RuntimeError, OSError) as error:
            # So that those notice, too, which wait for this one.
            if self._memory is not None:
                self._memory.close()
            dist.destroy_process_group()
            lost = self._roll_call()
            if not lost:
                raise RankLostError(f"the connection broke: {first_lines(error, 1)}") from error
            raise RankLostError(
                f"lost {' and '.join(lost)}, which died or has not answered for {TIMEOUT_S:g} s"
            ) from error

    def _roll_call(self) -> list[str]:
        """Names of those that do not answer: by torchrun's store, which outlives them."""
        missing = set(range(self.size))
        deadline = time.monotonic() + ROLL_CALL_S
        try:
            self._store.set(f"here {self.rank}", "")
            while missing and time.monotonic() < deadline:
                missing = {rank for rank in missing if not self._store.check([f"here {rank}"])}
                time.sleep(0.1)
        except RuntimeError:  # it is gone, too
            return []
        return [self.name(rank) for rank in sorted(missing)]


@contextmanager
def connected() -> Iterator[World]:
    """The processes that torchrun started this one with; it alone where torchrun did not."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield ALONE
        return
    _connect()
    try:
        world = Processes()
        if world.writes:
            yield world
            return
        # What all of them would tell, and warn of, is told once.
        logging.getLogger("ventosa").setLevel(logging.ERROR)
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            yield world
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()


def _connect() -> None:
    """Joins the others: by nccl for what is on GPUs, by gloo for all else."""
    timeout = timedelta(seconds=TIMEOUT_S)
    store, rank, size = next(dist.rendezvous("env://", timeout=timeout))
    # Started again, processes find the addresses of those before them in torchrun's store.
    store = dist.PrefixStore(f"start {restarts()}", store)
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=timeout)


def restarts() -> int:
    """How often torchrun has started the processes again."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
