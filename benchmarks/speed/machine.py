"""What the machine can do at most: memory's bandwidth and float32 arithmetic, a core and all."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from envs.grasp.compiled import compiled
from trainers.common.cores import usable_cores
from trainers.common.errors import UserError

Floats = NDArray[np.float32]

TRIAD_NUMBERS = 2**24
"""In each of three arrays, which no cache holds."""
TRIAD_BYTES = 12
"""Of one number: two are read and one is written."""
LANES = 128
"""Numbers that are added up side by side: as many as it takes to hide how long an addition is."""
ADDITIONS = 200_000
PRODUCT_SIDE = 1024


@dataclass(frozen=True)
class Machine:
    """What some cores can do in a second, at most.

    Attributes:
        operations: of float32, a fused multiplication and addition counting as two.
        bytes: to and from memory.
        product_operations: those of torch's product of two matrices.
    """

    operations: float
    bytes: float
    product_operations: float


@compiled(nogil=True, fastmath=True)
def triad(total: Floats, first: Floats, second: Floats, factor: np.float32) -> None:
    """McCalpin's triad, "Memory bandwidth and machine balance in current computers", 1995."""
    for i in range(len(total)):
        total[i] = first[i] + factor * second[i]


@compiled(nogil=True, fastmath=True)
def multiply_and_add(numbers: Floats, times: int) -> None:
    """Fused multiplications and additions on numbers that stay in the registers."""
    factor, term, sums = np.float32(0.999), np.float32(0.001), np.zeros(LANES, np.float32)
    for _ in range(times):
        for i in range(LANES):
            sums[i] = sums[i] * factor + term
    numbers[:] = sums


def machine(cores: int, seconds: float) -> Machine:
    """Measures some cores together.

    What a core does is the most that one of its threads was seen to do in a second of its own time,
    so that others who compute as well hardly change it.

    Args:
        cores: how many.
        seconds: of each measurement, at least.
    """
    return Machine(
        operations=_together(cores, _additions, seconds),
        bytes=_together(cores, _triads, seconds),
        product_operations=_together(cores, _products, seconds),
    )


def _additions() -> tuple[Callable[[], object], float]:
    numbers = np.zeros(LANES, np.float32)
    return lambda: multiply_and_add(numbers, ADDITIONS), 2.0 * LANES * ADDITIONS


def _triads() -> tuple[Callable[[], object], float]:
    total, first, second = (np.ones(TRIAD_NUMBERS, np.float32) for _ in range(3))
    factor = np.float32(0.5)
    return lambda: triad(total, first, second, factor), float(TRIAD_BYTES * TRIAD_NUMBERS)


def _products() -> tuple[Callable[[], object], float]:
    torch.set_num_threads(1)  # of this thread alone
    first, second = torch.ones(2, PRODUCT_SIDE, PRODUCT_SIDE)
    return lambda: first @ second, 2.0 * PRODUCT_SIDE**3


def _together(
    cores: int, make: Callable[[], tuple[Callable[[], object], float]], seconds: float
) -> float:
    """The sum of the speeds that so many threads reach at the same time.

    Args:
        cores: threads.
        make: makes each one's work, and says how much it is.
        seconds: of each thread.
    """
    ready, speeds = threading.Barrier(cores), [0.0] * cores

    def run(number: int) -> None:
        work, amount = make()
        work()  # compiles
        ready.wait()
        end_s = time.thread_time() + seconds
        while True:
            start_s = time.thread_time()
            work()
            now_s = time.thread_time()
            speeds[number] = max(speeds[number], amount / (now_s - start_s))
            if now_s >= end_s:
                return

    threads = [threading.Thread(target=run, args=(number,)) for number in range(cores)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sum(speeds)


@contextmanager
def threads_for(cores: int) -> Iterator[None]:
    """Lets this thread, torch, and thread pools that are made meanwhile use so many cores.

    Raises:
        UserError: the system can't be told.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise UserError("limits: a system is needed that lets a thread choose its cores: use Linux")
    allowed, threads = os.sched_getaffinity(0), torch.get_num_threads()
    os.sched_setaffinity(0, sorted(allowed)[:cores])
    torch.set_num_threads(min(cores, usable_cores()))
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)
        torch.set_num_threads(threads)
