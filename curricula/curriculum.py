"""The contract of a curriculum: pure functions of a state that fits in JSON."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from curricula.samplers import ParameterValue

State = dict[str, Any]
"""Everything that a curriculum keeps from step to step, made of what JSON knows."""


@dataclass(frozen=True)
class FinishedEpisodes:
    """Episodes of the current lesson that ended, each shown once.

    They were all reset with the lesson's own parameters. Their order is that in which they began,
    without gaps, so that the first n, or n in a row, are like any others: no short ones first.

    Attributes:
        rewards: (k,) cumulative reward of each, in the order in which they began.
        successes: (k,) whether each ended in success.
        run_fraction: Training steps done over the run's ``max_steps``, in [0, 1].

    Raises:
        ValueError: The arrays are not (k,) both, or a reward is not finite.
    """

    rewards: NDArray[np.floating]
    successes: NDArray[np.bool_]
    run_fraction: float

    def __post_init__(self) -> None:
        if self.rewards.ndim != 1 or self.rewards.shape != self.successes.shape:
            raise ValueError(
                "rewards and successes must have one value per episode, not the shapes "
                f"{self.rewards.shape} and {self.successes.shape}"
            )
        if not np.isfinite(self.rewards).all():
            raise ValueError("the cumulative reward of an episode is not a finite number")


class Curriculum(Protocol):
    """Chooses the environment's parameters from how the training goes.

    A curriculum keeps nothing in itself: the state goes into the checkpoint, and a run that reads
    it back goes on exactly. It may have a method `all_parameters()`, too, of the environment
    parameters of each lesson: all of them are checked before a run begins.
    """

    @property
    def lesson_count(self) -> int:
        """Number of lessons."""
        ...

    def initial_state(self) -> State:
        """State at the start of a run."""
        ...

    def advance(self, state: State, episodes: FinishedEpisodes) -> State:
        """State after some episodes; ``state`` itself is left as it is."""
        ...

    def lesson(self, state: State) -> int:
        """Index of the current lesson, from 0."""
        ...

    def lesson_name(self, state: State) -> str | None:
        """Name of the current lesson, which the log shows next to its number; None without one."""
        ...

    def parameters(self, state: State) -> dict[str, ParameterValue]:
        """Environment parameters of the current lesson: numbers or samplers."""
        ...

    def final_parameters(self) -> dict[str, ParameterValue]:
        """Environment parameters of the last lesson, on which policies are judged."""
        ...
