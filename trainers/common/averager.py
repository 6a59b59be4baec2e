"""Means of named values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

MOST = 2**53
"""Counts from here on are no exact floating-point numbers."""


class Averager:
    """Means of named values over everything added since they were last taken."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def add(self, values: Mapping[str, float], count: int = 1) -> None:
        """Add values; each is itself the mean of `count` samples (none are added if it is 0)."""
        if count == 0:
            return
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + float(value) * count
            self._counts[name] = self._counts.get(name, 0) + count

    def add_sums(self, state: Mapping[str, Any]) -> None:
        """Add all that another one was given, from its state."""
        for name, total in state["sums"].items():
            self._sums[name] = self._sums.get(name, 0.0) + total
            self._counts[name] = self._counts.get(name, 0) + state["counts"][name]

    def means(self) -> dict[str, float]:
        """The mean of each name that got a value."""
        return {name: total / self._counts[name] for name, total in self._sums.items()}

    def pop_means(self) -> dict[str, float]:
        """The mean of each name that got a value; then start anew."""
        means = self.means()
        self._sums, self._counts = {}, {}
        return means

    def state_dict(self) -> dict[str, Any]:
        """What was added, to go on from; without what is not finite."""
        sums = {name: total for name, total in self._sums.items() if math.isfinite(total)}
        return {"sums": sums, "counts": {name: self._counts[name] for name in sums}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go back to a state.

        Raises:
            ValueError: there are other counts than sums, or something is no number of its kind.
        """
        sums, counts = state["sums"], state["counts"]
        if not all(type(total) is float and math.isfinite(total) for total in sums.values()):
            raise ValueError(f"sums that are no finite numbers: {sums}")
        if not all(type(counts[name]) is int and 1 <= counts[name] < MOST for name in sums):
            raise ValueError(f"counts that are none: {counts}")
        self._sums, self._counts = dict(sums), {name: counts[name] for name in sums}
