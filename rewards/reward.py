"""The contract of a reward, and how an environment pays it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

SnapshotT = TypeVar("SnapshotT")
SnapshotT_contra = TypeVar("SnapshotT_contra", contravariant=True)


class RewardError(ValueError):
    """A reward returned anything but numbers (N,); the message names it."""


class Reward(Protocol[SnapshotT_contra]):
    """A term of the reward, built from its ``Settings``; the environment applies its weight.

    It is computed from a snapshot of N transitions, whose type is the environment's. A class says
    which it needs in ``snapshot: ClassVar[type]``; one that doesn't is taken by any environment.
    """

    def __call__(self, snapshot: SnapshotT_contra, /) -> NDArray[np.float64]:
        """Unweighted rewards (N,) of one step of N environments."""
        ...


@dataclass(frozen=True)
class RewardTerm(Generic[SnapshotT_contra]):
    """A reward as a run lists it: its name in the log, its weight, and how it is computed."""

    name: str
    weight: float
    reward: Reward[SnapshotT_contra]


def fits(reward: object, snapshot: type) -> bool:
    """Whether a reward, or its class, can be computed from a type of snapshot."""
    return issubclass(snapshot, getattr(reward, "snapshot", object))


def fitting(
    terms: Sequence[RewardTerm[Any]], snapshot: type[SnapshotT]
) -> tuple[RewardTerm[SnapshotT], ...]:
    """The same terms, known to be computed from what an environment hands out.

    Args:
        terms: the run's.
        snapshot: the type that the environment hands out.

    Raises:
        ValueError: a reward is computed from another type; the message names both.
    """
    for term in terms:
        if not fits(term.reward, snapshot):
            needed = getattr(term.reward, "snapshot", object)
            raise ValueError(
                f"the reward {term.name!r} is computed from a {needed.__name__}, and this "
                f"environment hands out a {snapshot.__name__}: leave it out, or take a reward for "
                f"{snapshot.__module__}.{snapshot.__qualname__}"
            )
    return tuple(terms)


def weigh(
    terms: Sequence[RewardTerm[SnapshotT]], snapshot: SnapshotT, count: int
) -> dict[str, NDArray[np.float64]]:
    """Weighted rewards (N,) of one step of N = `count` environments, by name.

    Raises:
        RewardError: a reward returned anything but N numbers.
    """
    weighted = {}
    for term in terms:
        returned = term.reward(snapshot)
        try:
            values = np.asarray(returned, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise RewardError(
                f"the reward {term.name!r} returned no numbers: {error}; it must return ({count},)"
            ) from error
        if values.shape != (count,):
            raise RewardError(
                f"the reward {term.name!r} returned an array of shape {values.shape} for {count} "
                f"environments: it must return ({count},)"
            )
        weighted[term.name] = term.weight * values
    return weighted
