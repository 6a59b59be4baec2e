"""Steps per second of PPO's training loop: this project's and Stable-Baselines3's, in turn.

Both act in the same batched environment, with the same network, hyper-parameters and threads.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Protocol

from benchmarks.speed.figures import MODES, OURS, PEER, Case, Figure
from benchmarks.speed.setup import Setup
from benchmarks.speed.timing import Samples, interleave
from benchmarks.speed.ventosa import Ventosa
from trainers.timers import Timer, recording

WHATS = {
    "collection steps": "collect",
    "update steps": "update",
    "training steps": None,
}
"""What is measured, and the timer it is read from; None: the whole loop."""


class Contender(Protocol):
    """A trainer with its environments.

    Attributes:
        parameters: how many its networks have.
    """

    parameters: int

    def learn(self, buffers: int) -> None:
        """Trains on so many buffers, and times `collect` and `update` as parts."""

    def close(self) -> None:
        """Ends the environments."""


def contenders(peer: bool) -> dict[str, Callable[[Setup], Contender]]:
    """What is compared: this project's trainer and, where it is installed, its peer."""
    chosen: dict[str, Callable[[Setup], Contender]] = {OURS: Ventosa}
    if peer:
        # Imported late, for it needs the extra `bench`.
        from benchmarks.speed.stable_baselines import StableBaselines  # noqa: PLC0415

        chosen[PEER] = StableBaselines
    return chosen


def measure(
    sizes: Sequence[int],
    setup: Setup,
    repeats: int,
    seconds: float,
    makers: Mapping[str, Callable[[Setup], Contender]],
) -> tuple[list[Figure], dict[int, int]]:
    """Measures the training loops.

    Args:
        sizes: sides of the images in pixels.
        setup: everything else that both have in common.
        repeats: rounds.
        seconds: of each measurement, rounded up to whole buffers.
        makers: build the contenders.

    Returns:
        The figures; and, by size, how many parameters the networks of both have.

    Raises:
        RuntimeError: they differ in that.
    """
    figures, parameters = [], {}
    for size in sizes:
        for mode in MODES:
            with ExitStack() as stack:
                teams = {}
                for name, make in makers.items():
                    teams[name] = make(setup.with_images(size, mode))
                    stack.callback(teams[name].close)
                parameters[size] = _common_parameters(teams)
                measures = {
                    name: partial(_speeds, one, setup.buffer_size, _buffers(one, seconds))
                    for name, one in teams.items()
                }
                found = interleave(measures, repeats)
            for name, rounds in found.items():
                for what in WHATS:
                    case = Case(what, size, mode, setup.num_envs)
                    values = tuple(speeds[what] for speeds in rounds)
                    figures.append(Figure(case, name, Samples(values)))
    return figures, parameters


def _common_parameters(teams: Mapping[str, Contender]) -> int:
    counts = {name: one.parameters for name, one in teams.items()}
    if len(set(counts.values())) > 1:
        raise RuntimeError(f"the networks differ in their numbers of parameters: {counts}")
    return next(iter(counts.values()))


def _buffers(contender: Contender, seconds: float) -> int:
    """How many buffers fill a measurement, after one to compile and to settle."""
    contender.learn(1)
    start_s = time.perf_counter()
    contender.learn(1)
    return math.ceil(seconds / (time.perf_counter() - start_s))


def _speeds(contender: Contender, buffer_size: int, buffers: int) -> dict[str, float]:
    """Steps per second of the whole loop and its two parts."""
    root = Timer()
    with recording(root):
        contender.learn(buffers)
    steps = buffers * buffer_size
    return {
        what: steps / (root if part is None else root.children[part]).total_s
        for what, part in WHATS.items()
    }
