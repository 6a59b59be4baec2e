"""Steps per second of PPO's training loop: this project's and Stable-Baselines3's, in turn.

Both act in the same batched environment, with the same network, hyper-parameters and threads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Protocol

from benchmarks.speed.figures import MODES, OURS, PEER, Case, Figure
from benchmarks.speed.setup import Setup
from benchmarks.speed.timing import Samples, interleave
from benchmarks.speed.ventosa import Ventosa
from trainers.common.timers import Timer, recording

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

    def learn(self) -> None:
        """Fills one buffer and learns from it; times `collect` and `update` as parts."""

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
    setup: Setup,
    repeats: int,
    seconds: float,
    makers: Mapping[str, Callable[[Setup], Contender]],
) -> tuple[list[Figure], int]:
    """Measures the training loops.

    Args:
        setup: what all have in common; the mode is set here.
        repeats: rounds.
        seconds: of each measurement, rounded up to whole buffers.
        makers: build the contenders.

    Returns:
        The figures; and how many parameters the networks have.

    Raises:
        RuntimeError: the contenders differ in that.
    """
    figures, parameters = [], 0
    for mode in MODES:
        with ExitStack() as stack:
            teams = {}
            for name, make in makers.items():
                teams[name] = make(replace(setup, mode=mode))
                stack.callback(teams[name].close)
            parameters = _common_parameters(teams)
            for team in teams.values():
                team.learn()  # compiles, and takes what memory it needs
            measures = {
                name: partial(_speeds, team, setup.buffer_size, seconds)
                for name, team in teams.items()
            }
            found = interleave(measures, repeats)
        for name, rounds in found.items():
            for what in WHATS:
                case = Case(what, setup.size, mode, setup.num_envs)
                figures.append(Figure(case, name, Samples(tuple(one[what] for one in rounds))))
    return figures, parameters


def _common_parameters(teams: Mapping[str, Contender]) -> int:
    counts = {name: one.parameters for name, one in teams.items()}
    if len(set(counts.values())) > 1:
        raise RuntimeError(f"the networks differ in their numbers of parameters: {counts}")
    return next(iter(counts.values()))


def _speeds(contender: Contender, buffer_size: int, seconds: float) -> dict[str, float]:
    """Steps per second of the whole loop and its two parts."""
    root, steps = Timer(), 0
    while root.total_s < seconds:
        with recording(root):
            contender.learn()
        steps += buffer_size
    return {
        what: steps / (root if part is None else root.children[part]).total_s
        for what, part in WHATS.items()
    }
