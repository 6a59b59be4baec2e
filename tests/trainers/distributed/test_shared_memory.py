"""What processes of one machine exchange through the memory that they share."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import time
from collections.abc import Callable
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from trainers.distributed.shared_memory import SharedMemory, connected_sockets

TIMEOUT_S = 60.0
PROCESSES = multiprocessing.get_context("fork")
Work = Callable[[int, SharedMemory], Any]


def in_processes(size: int, work: Work, timeout_s: float = TIMEOUT_S) -> dict[int, Any]:
    """What a function returns in each of k processes, or raises there; nothing of one that died."""
    names, results = PROCESSES.SimpleQueue(), PROCESSES.SimpleQueue()

    def first(name: bytes) -> bytes:
        for _ in range(size - 1 if name else 0):
            names.put(name)
        return name or names.get()

    def run(rank: int) -> None:
        torch.set_num_threads(1)
        peers = connected_sockets(rank, size, first, timeout_s)
        try:
            results.put((rank, work(rank, SharedMemory(rank, size, peers))))
        except OSError as error:
            results.put((rank, type(error)))

    processes = [PROCESSES.Process(target=run, args=(rank,)) for rank in range(size)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(TIMEOUT_S)
        assert process.exitcode is not None, "it hangs"
    return dict(results.get() for _ in processes if not results.empty())


def values_of(rank: int, count: int, turn: int = 0) -> Tensor:
    """Numbers whose sum depends on the order that they are added in."""
    generator = torch.Generator().manual_seed(1000 * turn + rank)
    return torch.randn(count, generator=generator) * 10.0 ** (rank % 3)


@pytest.mark.parametrize("size", [2, 3, 8])  # 8 are more than many machines have cores
def test_sums_are_those_in_the_order_of_ranks_to_the_last_bit(size: int) -> None:
    """Over and over, of few values and of many, while the processes run ahead of each other."""
    counts = [1, 5, 10_000, 3, size - 1, 100_001, 7] * 2

    def work(rank: int, memory: SharedMemory) -> list[Tensor]:
        wrong = []
        for turn, count in enumerate(counts):
            time.sleep(0.002 * ((turn + rank) % 3))
            own = values_of(rank, count, turn)
            expected = reduce(add, [0.5 * values_of(other, count, turn) for other in range(size)])
            if not torch.equal(memory.sum(own.split([1, count - 1]), 0.5), expected):
                wrong.append(count)
        return wrong

    assert in_processes(size, work) == {rank: [] for rank in range(size)}
    assert not torch.equal(  # so that another order would be noticed
        reduce(add, [values_of(rank, 1000) for rank in range(3)]),
        reduce(add, [values_of(rank, 1000) for rank in reversed(range(3))]),
    )


def test_sums_keep_the_kind_of_the_values() -> None:
    def work(rank: int, memory: SharedMemory) -> list[Any]:
        few = memory.sum([torch.tensor([rank + 1.0])], 1.0)
        exact = memory.sum([torch.tensor([2.0**-40 + rank], dtype=torch.float64)], 1.0)
        return [few.dtype, few.item(), exact.dtype, exact.item()]

    expected = [torch.float32, 3.0, torch.float64, 1.0 + 2.0**-39]
    assert list(in_processes(2, work).values()) == [expected] * 2


def test_everyones_values_come_by_rank_whatever_their_sizes() -> None:
    def work(rank: int, memory: SharedMemory) -> Any:
        few = memory.gather({"rank": rank})
        many = memory.gather(bytes([rank]) * 10 ** (3 * rank))
        again = memory.gather(None if rank else torch.arange(3))
        return few, [(len(part), set(part)) for part in many], again[0].tolist(), again[1:]

    expected = (
        [{"rank": 0}, {"rank": 1}, {"rank": 2}],
        [(1, {0}), (1_000, {1}), (1_000_000, {2})],
        [0, 1, 2],
        [None, None],
    )
    assert in_processes(3, work) == dict.fromkeys(range(3), expected)


def test_what_is_for_the_first_is_read_by_no_other_and_large_places_are_given_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("trainers.distributed.shared_memory.KEPT_BYTES", 10**6)

    def work(rank: int, memory: SharedMemory) -> Any:
        few = memory.gather(rank, to_first=True)
        kept = memory._places.nbytes
        many = memory.gather(bytes(10**6), to_first=True)
        return few, kept > 0, list(map(len, many)), memory._places.nbytes, memory.gather(rank)

    found = in_processes(2, work)
    assert found[0] == ([0, 1], True, [10**6, 10**6], 0, [0, 1])
    assert found[1] == ([], True, [], 0, [0, 1])


EXCHANGES: dict[str, Callable[[SharedMemory], Any]] = {
    "sum": lambda memory: memory.sum([torch.ones(100_000)], 1.0),
    "gather": lambda memory: memory.gather(torch.ones(100_000)),
    "pool": lambda memory: memory.pool([torch.ones(100_000, 2)]),
}


@pytest.mark.parametrize("dies", [0, 1])
@pytest.mark.parametrize("exchange", EXCHANGES)
def test_one_that_is_killed_is_noticed_at_once_by_all(dies: int, exchange: str) -> None:
    def work(rank: int, memory: SharedMemory) -> float:
        memory.sum([torch.ones(4)], 1.0)
        if rank == dies:
            time.sleep(0.2)  # the others wait
            os.kill(os.getpid(), signal.SIGKILL)
        try:
            EXCHANGES[exchange](memory)
        finally:
            memory.close()  # so that those notice who wait for this one

    begin = time.monotonic()
    ends = in_processes(3, work)
    assert ends.keys() == {0, 1, 2} - {dies}
    assert all(issubclass(end, ConnectionError) for end in ends.values())
    assert time.monotonic() - begin < 10.0


def test_one_that_does_not_come_is_waited_for_no_longer_than_is_said() -> None:
    def work(rank: int, memory: SharedMemory) -> Tensor:
        if rank == 1:
            time.sleep(1.0)
        return memory.sum([torch.ones(1)], 1.0)

    assert in_processes(2, work, timeout_s=0.2)[0] is TimeoutError


ONLY_IN_MEMORY = frozenset({"/memfd:ventosa (deleted)"})


def test_nothing_can_be_left_of_what_is_shared() -> None:
    """It is no file from the beginning, so that nobody need take it away, however all end."""

    def mapped() -> set[tuple[str, str]]:
        maps = Path("/proc/self/maps").read_text()
        shared = r"^(\S+) rw-s .* (/(?:memfd:|dev/shm/(?!sem\.)).*)$"
        return set(re.findall(shared, maps, re.MULTILINE))

    def work(rank: int, memory: SharedMemory) -> set[str]:
        before = mapped()  # of other tests
        memory.sum([torch.ones(100_000)], 1.0)
        return {name for _, name in mapped() - before}

    assert in_processes(2, work) == dict.fromkeys(range(2), ONLY_IN_MEMORY)


def test_a_pool_has_everyones_rows_by_rank_and_is_filled_anew() -> None:
    """Ranks have more rows or fewer, none at all among them, and rows may hold nothing."""
    counts = [3, 0, 5]

    def work(rank: int, memory: SharedMemory) -> Any:
        found = []
        for turn in (1, 40, 2):
            rows = torch.full((turn * counts[rank], 2, 1), 10 * turn + rank, dtype=torch.uint16)
            numbers = torch.full((turn * counts[rank],), 0.5 * rank)
            pooled = memory.pool([rows, torch.empty(len(rows), 0), numbers])
            found.append([(tensor.dtype, tensor.shape, tensor.tolist()) for tensor in pooled])
        return found

    def expected(turn: int) -> list[Any]:
        owners = [rank for rank, count in enumerate(counts) for _ in range(turn * count)]
        rows = [[[10 * turn + owner]] * 2 for owner in owners]
        return [
            (torch.uint16, (8 * turn, 2, 1), rows),
            (torch.float32, (8 * turn, 0), [[]] * (8 * turn)),
            (torch.float32, (8 * turn,), [0.5 * owner for owner in owners]),
        ]

    everything = [expected(turn) for turn in (1, 40, 2)]
    assert list(in_processes(3, work).values()) == [everything] * 3
