"""What a run can be taken up from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from trainers.saving.serialization import snapshot

ALGORITHM = "algorithm"
"""Part of a session's state: the one that an update changes, next to the weights."""

MOST_WEIGHTS, LEAST_BYTES = 8, 2**20
"""A copy may be so many times as large as the weights; or so large, where they are small."""


@dataclass(frozen=True)
class Resumable:
    """What a run can be taken up from: all that acts in it, at one of its steps.

    Attributes:
        step: environment steps taken.
        weights: the policy's.
        state: of the session.
    """

    step: int
    weights: Mapping[str, Tensor]
    state: Mapping[str, Any]

    def copied(self) -> Resumable | None:
        """The same, out of reach of an update; None where there is too much of it.

        With weights and optimizers it costs less than one of an update's many optimizer steps,
        which go through all of these. With a replay buffer it would not.
        """
        size = sum(weights.nbytes for weights in self.weights.values())
        changed = (dict(self.weights), self.state[ALGORITHM])
        copy = snapshot(changed, max(MOST_WEIGHTS * size, LEAST_BYTES))
        if copy is None:
            return None
        weights, algorithm = copy
        return replace(self, weights=weights, state={**self.state, ALGORITHM: algorithm})
