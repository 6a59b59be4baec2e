"""Actions of the running episodes, so that they can be played again."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

LEAST_CAPACITY = 64  # steps


class ActionHistory:
    """The latest actions of N environments.

    They grow at the end of an array and are dropped at its beginning. What was handed out is never
    written to: where the array is full, those that are left move to a new one.

    Args:
        shape: of one step's actions, (N, ...).
        dtype: of the actions.
    """

    def __init__(self, shape: tuple[int, ...], dtype: Any):
        self._array = np.empty((LEAST_CAPACITY, *shape), dtype)
        self._begin = self._end = 0

    @property
    def actions(self) -> NDArray[Any]:
        """(T, N, ...) oldest first, without a copy; for reading."""
        return self._array[self._begin : self._end]

    def append(self, actions: NDArray[Any]) -> None:
        """Keeps a copy of one step's actions (N, ...)."""
        if self._end == len(self._array):
            self._move(self.actions)
        self._array[self._end] = actions
        self._end += 1

    def keep(self, steps: int) -> None:
        """Drops all but the latest steps."""
        self._begin = self._end - steps

    def load(self, actions: NDArray[Any]) -> None:
        """Goes back to (T, N, ...), of which it keeps a copy."""
        self._move(actions)

    def _move(self, kept: NDArray[Any]) -> None:
        """Puts some actions at the beginning of a new array, of twice their size."""
        shape = (max(LEAST_CAPACITY, 2 * len(kept)), *self._array.shape[1:])
        self._array = np.empty(shape, self._array.dtype)
        self._array[: len(kept)] = kept
        self._begin, self._end = 0, len(kept)
