"""Means of named values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


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

    def means(self) -> dict[str, float]:
        """The mean of each name that got a value."""
        return {name: total / self._counts[name] for name, total in self._sums.items()}

    def pop_means(self) -> dict[str, float]:
        """The mean of each name that got a value; then start anew."""
        means = self.means()
        self._sums, self._counts = {}, {}
        return means

    def state_dict(self) -> dict[str, Any]:
        """What was added, to go on from."""
        return {"sums": dict(self._sums), "counts": dict(self._counts)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go back to a state.

        Raises:
            ValueError: there are other counts than sums, or something is no number of its kind.
        """
        sums, counts = state["sums"], state["counts"]
        if any(isinstance(number, bool) for number in (*sums.values(), *counts.values())):
            raise ValueError(f"sums {sums} and counts {counts} that are no numbers")
        self._sums = {name: float(total) for name, total in sums.items()}
        self._counts = {name: int(counts[name]) for name in self._sums}
        if any(count < 1 for count in self._counts.values()):
            raise ValueError(f"counts that are not positive: {self._counts}")
