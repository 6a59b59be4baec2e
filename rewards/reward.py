"""The contract of a reward."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rewards.grasp.transition import GraspTransition


class Reward(Protocol):
    """A term of the reward, built from its ``Settings``; the environment applies its weight."""

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Return the unweighted rewards, of shape (N,), of one step of N environments."""
        ...


@dataclass(frozen=True)
class RewardTerm:
    """A reward as a run lists it: its name in the log, its weight, and how it is computed."""

    name: str
    weight: float
    reward: Reward


def weigh(
    terms: Sequence[RewardTerm], transition: GraspTransition
) -> dict[str, NDArray[np.float64]]:
    """Compute the weighted rewards (N,) of one step, by name.

    Raises:
        ValueError: A reward returned anything but N numbers; the message names it.
    """
    count = len(transition.tooltip_m)
    weighted = {}
    for term in terms:
        values = np.asarray(term.reward(transition), dtype=np.float64)
        if values.shape != (count,):
            raise ValueError(
                f"the reward {term.name!r} returned an array of shape {values.shape} for {count} "
                f"environments: it must return ({count},)"
            )
        weighted[term.name] = term.weight * values
    return weighted
