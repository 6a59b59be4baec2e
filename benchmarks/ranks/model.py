"""What an update costs k ranks: a model that is fitted to measurements, and what it predicts.

    T(k) = p (A + L + L d E(k) + g + h k) + S (l + b / B)

p ranks take turns on a core. A and L are what collection and learning take a rank, and S sums of b
bytes are told in an update, each in l + b / B seconds once the slowest rank has come to it: d is
the relative deviation of what ranks take between two sums, and E(k) the expected maximum of k
standard normal numbers. All else that is told takes g, and h for each rank that tells it.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ENVS, BUFFER, BATCH = 64, 2_048, 256
"""Of each rank."""


@dataclass(frozen=True)
class Measured:
    """What k ranks came to, in means over the ranks.

    Attributes:
        apart_s: of an update, its collection included, of ranks that tell each other nothing.
        together_s: of an update together with the others, which has these parts:
        collection_s: but for what ranks tell each other.
        learning_s: the same of all else.
        sums_s: telling each other gradients.
        gathers_s: telling each other all else.
        waiting_s: for those that have not come to it.
        sums: how often gradients are told.
        gradient_bytes: told at a time.
        sum_s: seconds of telling so many bytes, by how many.
        checkpoint_s: to gather what a checkpoint has of all ranks.
        checkpoint_bytes: of that.
        tries: actions at an image, unless one succeeds.
    """

    apart_s: float
    together_s: float
    collection_s: float
    learning_s: float
    sums_s: float
    gathers_s: float
    waiting_s: float
    sums: float
    gradient_bytes: float
    sum_s: Mapping[int, float]
    checkpoint_s: float
    checkpoint_bytes: float
    tries: float

    @classmethod
    def read(cls, paths: Sequence[Path]) -> Measured:
        """Medians over the turns of all that `benchmarks.ranks.rank` wrote."""
        found = [json.loads(path.read_text()) for path in paths]
        turns = [turn for one in found for turn in one.pop("turns")]
        sum_s = _medians([one.pop("sum_s") for one in found])
        by_size = {int(size): seconds for size, seconds in sum_s.items()}
        return cls(**_medians(turns), **_medians(found), sum_s=by_size)


def _medians(rows: Sequence[Mapping[Any, float]]) -> dict[Any, float]:
    return {name: statistics.median(row[name] for row in rows) for name in rows[0]}


@dataclass(frozen=True)
class Network:
    """How long it takes to tell a sum.

    Attributes:
        name: for people.
        latency_s: of a message.
        bytes_per_s: that one rank sends.
    """

    name: str
    latency_s: float
    bytes_per_s: float

    def sum_s(self, ranks: int, size: float) -> float:
        """Seconds of a sum of `size` bytes by halving and doubling (Thakur et al. 2005, 4.2).

        2 log2(k) messages one after the other, and 2 (k - 1) / k of the bytes.
        """
        sent = 2.0 * (ranks - 1) / ranks * size
        return 2.0 * math.ceil(math.log2(ranks)) * self.latency_s + sent / self.bytes_per_s


@dataclass(frozen=True)
class Model:
    """The parameters of the model; see above.

    Attributes:
        cores: C, of the machine that was measured.
        collection_s: A.
        learning_s: L.
        sums: S.
        gradient_bytes: b.
        latency_s: l, in shared memory.
        bytes_per_s: B, in shared memory.
        deviation: d.
        gathers_s: g and h.
        tries: actions at an image.
    """

    cores: int
    collection_s: float
    learning_s: float
    sums: float
    gradient_bytes: float
    latency_s: float
    bytes_per_s: float
    deviation: float
    gathers_s: tuple[float, float]
    tries: float

    @classmethod
    def fit(cls, measured: Mapping[int, Measured], cores: int) -> Model:
        """Fits the model to measurements, by the number of ranks: of one, and of several.

        Sums and waiting are taken from the most ranks that have a core each, or else the fewest.
        """
        one, several = measured[1], sorted(set(measured) - {1})
        ranks = max((k for k in several if k <= cores), default=several[0])
        found = measured[ranks]
        told = statistics.linear_regression(*zip(*found.sum_s.items(), strict=True))
        gathers = [measured[k].gathers_s / max(1.0, k / cores) for k in several]
        return cls(
            cores=cores,
            collection_s=one.collection_s,
            learning_s=one.learning_s,
            sums=found.sums,
            gradient_bytes=found.gradient_bytes,
            latency_s=told.intercept,
            bytes_per_s=1.0 / told.slope,
            deviation=found.waiting_s / (found.learning_s * expected_maximum(ranks)),
            gathers_s=_line(several, gathers),
            tries=found.tries,
        )

    def update_s(self, ranks: int, cores: int, network: Network | None = None) -> float:
        """Seconds of an update, collection included.

        Args:
            ranks: k.
            cores: for all of them.
            network: between machines of one core each; None: all ranks share memory.
        """
        work_s = self.collection_s + self.learning_s
        if ranks == 1:
            return work_s
        sum_s, deviation = self.latency_s + self.gradient_bytes / self.bytes_per_s, self.deviation
        if network is not None:
            sum_s = network.sum_s(ranks, self.gradient_bytes)
            deviation = math.hypot(deviation, own_deviation(ranks, self.tries))
        waiting_s = self.learning_s * deviation * expected_maximum(ranks)
        gathers_s = self.gathers_s[0] + self.gathers_s[1] * ranks
        return max(1.0, ranks / cores) * (work_s + waiting_s + gathers_s) + self.sums * sum_s

    def efficiency(self, ranks: int, network: Network | None = None) -> float:
        """Of k ranks with a core each: what they do, as a part of k times what one does."""
        return self.update_s(1, 1) / self.update_s(ranks, ranks, network)


def own_deviation(ranks: int, tries: float) -> float:
    """Relative deviation of how much of a minibatch is of a rank's own environments.

    Images of it are binomial, each with the actions tried at it. Where memory is not shared, a rank
    learns from those; what it does once in a step, however many they are, makes it a bit less.
    """
    images = BATCH / tries
    return math.sqrt((1.0 - 1.0 / ranks) / images)


def _line(ranks: Sequence[int], seconds: Sequence[float]) -> tuple[float, float]:
    """Intercept and slope through some points, neither below 0; through one, what is there."""
    if len(ranks) == 1:
        return seconds[0], 0.0
    line = statistics.linear_regression(ranks, seconds)
    if line.slope < 0.0:
        return statistics.mean(seconds), 0.0
    if line.intercept < 0.0:
        return 0.0, statistics.linear_regression(ranks, seconds, proportional=True).slope
    return line.intercept, line.slope


def expected_maximum(count: int) -> float:
    """Expected maximum of so many standard normal numbers: of their density k Phi^(k-1) phi."""
    x = np.linspace(-8.0, 8.0, 8_001)
    phi = np.exp(-x * x / 2.0) / math.sqrt(2.0 * math.pi)
    cumulated = np.cumsum(phi) * (x[1] - x[0])
    return float(np.sum(x * count * cumulated ** (count - 1) * phi) * (x[1] - x[0]))
