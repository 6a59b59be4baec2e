"""The snapshot of any gymnasium environment that rewards are computed from: one step of N."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class GymTransition:
    """A snapshot of N environments after one action, before any of them is reset.

    Attributes:
        observations: by name, (N, ...), before the action, as encoders see them.
        next_observations: by name, (N, ...), after the action; where an episode ended, its last.
        actions: (N, ...) as the environments took them.
        rewards: (N,) of the environments' own.
        terminated: (N,) the episode reached an end of its own.
        truncated: (N,) the episode was cut off.
        infos: the environments' own by name, (N, ...) as gymnasium batches them: beside each
            `name` stands `_name` (N,), which says who gave it.
    """

    observations: Mapping[str, NDArray[Any]]
    next_observations: Mapping[str, NDArray[Any]]
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    infos: Mapping[str, Any]
