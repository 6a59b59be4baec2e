"""Ranks that are threads of one process, and run as processes of torchrun would."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from trainers.distributed.world import Ranks

Result = TypeVar("Result")
TIMEOUT_S = 60.0


@dataclass
class Table:
    """Where k threads put what they tell each other."""

    size: int
    values: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.values = [None] * self.size
        self.barrier = threading.Barrier(self.size)


class ThreadRanks(Ranks):
    """One of k threads."""

    def __init__(self, rank: int, table: Table):
        super().__init__(rank, table.size)
        self._table = table

    def gather(self, value: Any) -> list[Any]:
        self._table.values[self.rank] = copy.deepcopy(value)
        self._table.barrier.wait(TIMEOUT_S)
        values = copy.deepcopy(self._table.values)
        self._table.barrier.wait(TIMEOUT_S)
        return values

    def sum(self, values: Tensor) -> Tensor:
        return torch.stack(self.gather(values)).sum(0)


@pytest.fixture
def ranks() -> Callable[[int], list[ThreadRanks]]:
    """k ranks, each for a thread of its own."""

    def build(size: int) -> list[ThreadRanks]:
        table = Table(size)
        return [ThreadRanks(rank, table) for rank in range(size)]

    return build


@pytest.fixture
def side_by_side() -> Callable[..., list[Any]]:
    """Results of a function, called with each of some things in a thread of its own."""

    def call(function: Callable[[Any], Result], things: Sequence[Any]) -> list[Result]:
        with ThreadPoolExecutor(len(things)) as pool:
            return list(pool.map(function, things))

    return call
