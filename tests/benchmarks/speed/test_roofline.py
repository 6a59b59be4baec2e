"""Limits, and how near pieces come to them; how fast anything is, is not looked at."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import pytest
import torch

from benchmarks.speed import limits, pieces
from benchmarks.speed.limits import limit, table_of_limits
from benchmarks.speed.machine import (
    ADDITIONS,
    LANES,
    Machine,
    machine,
    multiply_and_add,
    threads_for,
    triad,
)
from benchmarks.speed.pieces import Work
from envs.grasp.simulators.thread_pool import ThreadPool
from trainers.common.errors import UserError


def test_a_triad_and_a_chain_of_additions() -> None:
    total = np.zeros(3, np.float32)
    triad(total, np.float32([1, 2, 3]), np.float32([10, 20, 30]), np.float32(0.5))
    assert total.tolist() == [6, 12, 18]
    numbers = np.ones(LANES, np.float32)
    multiply_and_add(numbers, 2)
    # From 0: 0.001, and 0.999 times that and 0.001 more.
    assert numbers.tolist() == pytest.approx([0.001999] * LANES, rel=1e-6)


def test_a_machine_is_measured_by_its_cores_together() -> None:
    one = machine(1, 0.0)
    assert min(one.operations, one.bytes, one.product_operations) > 1e8
    # No core makes 256 operations of float32 in a cycle, at 8 GHz.
    assert 2 * ADDITIONS < one.operations < 256 * 8e9


@pytest.mark.parametrize(
    ("operations", "moved", "share", "bound"),
    [(50.0, 1.0, 0.25, "arithmetic"), (50.0, 6.0, 0.3, "memory"), (0.0, 20.0, 1.0, "memory")],
)
def test_the_limit_is_the_slower_of_the_two(
    operations: float, moved: float, share: float, bound: str
) -> None:
    # In the 2 s that an item takes, the machine makes 200 operations and moves 20 bytes.
    work = Work(lambda: 1, operations, moved)
    assert limit(work, 2.0, Machine(100.0, 10.0, 80.0)) == (pytest.approx(share), bound)


def test_threads_are_for_as_many_cores_as_asked() -> None:
    before = os.sched_getaffinity(0), torch.get_num_threads()
    with threads_for(1):
        assert len(os.sched_getaffinity(0)) == torch.get_num_threads() == 1
        parts: list[tuple[int, int]] = []
        ThreadPool().parallel_for(lambda *part: parts.append(part), 1000)
        assert parts == [(0, 1000)]
    assert (os.sched_getaffinity(0), torch.get_num_threads()) == before


def test_where_cores_cannot_be_chosen_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setaffinity")
    with pytest.raises(UserError, match="use Linux"), threads_for(1):
        pass


def test_traffic_is_what_operations_read_and_write() -> None:
    frames, rows = torch.zeros(1000, 8), torch.tensor([3, 5])
    with pieces._Traffic() as traffic:
        chosen = frames.index_select(0, rows)  # 64 bytes read and written
        chosen.t().add_(1.0)  # 64 read and written, the view for nothing
        torch.empty(10_000)
    assert traffic.bytes == 2 * 64 + 2 * 64
    with pieces._Traffic() as traffic:
        frames[rows] = chosen  # 64 bytes of numbers and two indices
    assert traffic.bytes == 2 * (64 + 2 * 8)


@pytest.mark.soak
def test_an_update_counts_the_operations_of_its_layers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pieces, "PPO_ENVS", 16)
    work = piece("PPO's update 80x80, stream")()
    try:
        work.prepare()
        assert work.do() == 32 * 16 * 4
    finally:
        work.close()
    # Multiplications of two convolutions and two layers of an image, and the heads of 4 and 1; all
    # are made once forwards and twice backwards, but for the images' own gradient.
    first, second = 19 * 19 * 16 * 64, 8 * 8 * 32 * 256
    layers = second + 2048 * 256 + 256 * 256 + 256 * 5
    assert work.operations == pytest.approx(2 * (2 * first + 3 * layers), rel=1e-6)
    # It reads a frame of bytes, and writes it as float32, at least.
    assert work.bytes > 80 * 80 * (1 + 4)


def test_the_table_has_times_and_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pieces, "COUNT", 4)
    monkeypatch.setattr(limits, "machine", lambda cores, seconds: Machine(2e9, 3e9, 1e9))
    wanted = {("a", "motion"): piece("contacts"), ("b", "image"): piece("color 80x80")}
    made = table_of_limits(0.0, wanted)
    assert made.row_count == 2
    cells = [list(column.cells) for column in made.columns]
    assert cells[0] == ["a", "b"]
    assert cells[4] == ["72", "90"]  # 14 * 80 * 80
    assert all("%" in share for share in cells[-1])
    assert "one core 2 Gop/s, 1 in torch's products of matrices, 3 GB/s;" in str(made.caption)


def piece(name: str) -> Callable[[], Work]:
    """One of the pieces."""
    return next(ready for (known, _), ready in pieces.pieces().items() if known == name)
