"""Contenders measured in turn, so that whatever else the machine does meets all of them alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

K = TypeVar("K")
T = TypeVar("T")


@dataclass(frozen=True)
class Samples:
    """One quantity, measured once in each round."""

    values: tuple[float, ...]

    @property
    def median(self) -> float:
        """The middle one."""
        return statistics.median(self.values)

    @property
    def low(self) -> float:
        """The smallest."""
        return min(self.values)

    @property
    def high(self) -> float:
        """The largest."""
        return max(self.values)

    def __truediv__(self, other: Samples) -> Samples:
        """Ratios within each round, which what slows a whole round down leaves as they are."""
        return Samples(tuple(a / b for a, b in zip(self.values, other.values, strict=True)))


def interleave(contenders: Mapping[K, Callable[[], T]], repeats: int) -> dict[K, list[T]]:
    """Measures the contenders in turn, A B A B ...; returns what each found, round by round."""
    found: dict[K, list[T]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, measure in contenders.items():
            found[name].append(measure())
    return found


def rate(
    work: Callable[[], int],
    seconds: float,
    prepare: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """How much work gets done per second.

    Args:
        work: called again and again, once at least; returns how much it did.
        seconds: of work, at least.
        prepare: called before each call of `work`; its time does not count.
        clock: tells the time in seconds.
    """
    done, spent_s = 0, 0.0
    while True:
        prepare()
        start_s = clock()
        done += work()
        spent_s += clock() - start_s
        if spent_s >= seconds:
            return done / spent_s
