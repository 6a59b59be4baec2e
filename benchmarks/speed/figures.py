"""How figures are taken: contenders in turn, several rounds, each beside its rival."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

FRAME_GRAB = "frame grab"
STREAM = "stream"
MODES = {FRAME_GRAB: True, STREAM: False}
"""How images are observed, and the environment's setting `frame_grab` for it."""

OURS = "ventosa"
PEER = "stable-baselines3"
FAST = "fast"
PYBULLET = "pybullet"
RIVALS = {OURS: PEER, FAST: PYBULLET}
"""Whom each contender is compared with."""


@dataclass(frozen=True)
class Samples:
    """One quantity, measured once in each round."""

    values: tuple[float, ...]

    @property
    def spread(self) -> tuple[float, float, float]:
        """Median, smallest and largest."""
        return statistics.median(self.values), min(self.values), max(self.values)

    def __truediv__(self, other: Samples) -> Samples:
        """Ratios within each round, which what slows a whole round down leaves as they are."""
        return Samples(tuple(a / b for a, b in zip(self.values, other.values, strict=True)))

    def __str__(self) -> str:
        digits = 0 if self.spread[0] >= 100 else 2
        median, low, high = (f"{value:,.{digits}f}" for value in self.spread)
        return f"{median} ({low} to {high})"


@dataclass(frozen=True)
class Case:
    """What was measured.

    Attributes:
        what: such as `depth frames` or `training steps`; figures are of so many a second.
        size: side of the images in pixels.
        mode: one of `MODES`; empty where it makes no difference.
        num_envs: environments, or worlds of a simulator.
    """

    what: str
    size: int
    mode: str
    num_envs: int


Figures = dict[Case, dict[str, Samples]]
"""Speeds per second of each case, by contender."""


def race(
    measures: Mapping[tuple[str, int], Callable[[], Mapping[str, float]]],
    size: int,
    mode: str,
    rounds: int,
) -> Figures:
    """Measures in turn, A B A B ..., so that whatever else the machine does meets all alike.

    Args:
        measures: by contender and its number of environments; return speeds per second by what.
        size: side of the images in pixels.
        mode: one of `MODES`, or empty.
        rounds: measurements of each contender.
    """
    found: Figures = {}
    for _ in range(rounds):
        for (contender, num_envs), measure in measures.items():
            for what, speed in measure().items():
                of_case = found.setdefault(Case(what, size, mode, num_envs), {})
                earlier = of_case[contender].values if contender in of_case else ()
                of_case[contender] = Samples((*earlier, speed))
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


def speedup(samples: Mapping[str, Samples]) -> Samples | None:
    """How many times as fast the first of two rivals is; None where one is missing."""
    for name, rival in RIVALS.items():
        if name in samples and rival in samples:
            return samples[name] / samples[rival]
    return None


def growth(figures: Figures) -> dict[tuple[int, str], float]:
    """How the time of a step of all N environments of `fast` grows with N, by size and mode.

    Returns:
        The exponent of N in the power law through them, by least squares, where there are several
        N; 1 is growth in proportion.
    """
    points: dict[tuple[int, str], list[tuple[float, float]]] = {}
    for case, samples in figures.items():
        step_s = case.num_envs / samples[FAST].spread[0]
        point = (math.log(case.num_envs), math.log(step_s))
        points.setdefault((case.size, case.mode), []).append(point)
    return {
        key: statistics.linear_regression(*zip(*found, strict=True)).slope
        for key, found in points.items()
        if len(found) > 1
    }
