"""Ranks that are threads of one process, and run as processes of torchrun would."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from trainers.distributed.shared_memory import SharedMemory
from trainers.distributed.world import Ranks

Result = TypeVar("Result")
TIMEOUT_S = 60.0


def memories(size: int) -> list[SharedMemory]:
    """What k ranks share, for each of them."""
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(size - 1)]
    for peer in (peer for pair in pairs for peer in pair):
        peer.settimeout(TIMEOUT_S)
    first = SharedMemory(0, size, [own for own, _ in pairs])
    others = enumerate((theirs for _, theirs in pairs), start=1)
    return [first, *(SharedMemory(rank, size, [peer]) for rank, peer in others)]


class ThreadRanks(Ranks):
    """One of k threads, which share memory; or not, as if they were on several machines."""

    shares_memory = True

    def __init__(self, rank: int, size: int, memory: SharedMemory):
        super().__init__(rank, size)
        self.memory = memory

    def gather(self, value: Any) -> list[Any]:
        return self.memory.gather(value)

    def gather_to_first(self, value: Any) -> list[Any]:
        return self.memory.gather(value, to_first=True)

    def sum(self, parts: Sequence[Tensor], weight: float) -> Tensor:
        return self.memory.sum(parts, weight)

    def pool(self, tensors: Sequence[Tensor]) -> Sequence[Tensor]:
        return self.memory.pool(tensors)


@pytest.fixture(autouse=True)
def _cudnn_is_as_before() -> Iterator[None]:
    """TRPO switches it off for a moment: threads, other than processes, put back each other's."""
    yield
    torch.backends.cudnn.enabled = True


@pytest.fixture
def ranks() -> Iterator[Callable[[int], list[ThreadRanks]]]:
    """k ranks, each for a thread of its own."""
    built: list[ThreadRanks] = []

    def build(size: int) -> list[ThreadRanks]:
        made = [ThreadRanks(rank, size, memory) for rank, memory in enumerate(memories(size))]
        built.extend(made)
        return made

    yield build
    for rank in built:
        rank.memory.close()


@pytest.fixture
def side_by_side() -> Callable[..., list[Any]]:
    """Results of a function, called with each of some things in a thread of its own."""

    def call(function: Callable[[Any], Result], things: Sequence[Any]) -> list[Result]:
        with ThreadPoolExecutor(len(things)) as pool:
            return list(pool.map(function, things))

    return call
