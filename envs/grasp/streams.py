"""Random numbers of N environments, each of which has a stream of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled
from envs.grasp.threefry import threefry

Size = int | tuple[int, ...]


class EnvironmentStreams:
    """What environment i draws depends on the seed, i and how much it drew before, and on no other.

    Args:
        seed: of them all.
        first: number of the first of them.
        count: N.

    Attributes:
        state: (N, 2) uint64, the key of each, and how many numbers it drew.
    """

    def __init__(self, seed: int, first: int, count: int):
        spawned = np.random.SeedSequence(seed).generate_state(1, np.uint64)
        keys = np.empty((1, count), np.uint64)
        _fill(np.array([[spawned[0], first]], np.uint64), np.zeros(1, np.int64), keys)
        self.state = np.stack([keys[0], np.zeros_like(keys[0])], axis=1)

    @classmethod
    def of(cls, state: NDArray[np.uint64] | None) -> EnvironmentStreams | None:
        """Those that were left in a state; None where there were none."""
        if state is None:
            return None
        streams = cls(0, 0, len(state))
        streams.state = state.copy()
        return streams

    def rows(self, indices: NDArray[np.int64]) -> RowGenerator:
        """What some of them (n,) draw by."""
        return RowGenerator(self.state, indices)


class RowGenerator:
    """Draws arrays whose row i is of environment i of n; as numpy's `Generator`, as far as it goes.

    Args:
        state: of the streams, which it goes on with.
        indices: (n,) of the environments.
    """

    def __init__(self, state: NDArray[np.uint64], indices: NDArray[np.int64]):
        self._state, self._indices = state, indices

    def random(self, size: Size) -> NDArray[np.float64]:
        """Uniform in [0, 1)."""
        return (self._bits(size) >> np.uint64(11)) * np.float64(2.0**-53)

    def uniform(self, low: float, high: float, size: Size) -> NDArray[np.float64]:
        """Uniform in [low, high)."""
        return low + (high - low) * self.random(size)

    def normal(self, mean: float, deviation: float, size: Size) -> NDArray[np.float64]:
        """Normally distributed, by the transform of Box and Muller (1958)."""
        radius = np.sqrt(-2.0 * np.log1p(-self.random(size)))
        return mean + deviation * radius * np.cos(2.0 * np.pi * self.random(size))

    def integers(
        self, low: int, high: int | None = None, size: Size = 0, dtype: Any = np.int64
    ) -> NDArray[Any]:
        """Integers from low, or from 0 to low, without the last; few of them, or 2^63 or 2^64."""
        low, high = (0, low) if high is None else (low, high)
        if high in (2**63, 2**64):
            return (self._bits(size) >> np.uint64(high == 2**63)).astype(dtype)
        return (low + np.floor((high - low) * self.random(size))).astype(dtype)

    def _bits(self, size: Size) -> NDArray[np.uint64]:
        shape = (size,) if isinstance(size, int) else size
        if shape[0] != len(self._indices):
            raise ValueError(f"{shape} is not of the {len(self._indices)} environments that draw")
        drawn = np.empty((shape[0], int(np.prod(shape[1:]))), np.uint64)
        _fill(self._state, self._indices, drawn)
        return drawn.reshape(shape)


@compiled()
def _fill(state: NDArray[np.uint64], indices: NDArray[np.int64], drawn: NDArray[np.uint64]) -> None:
    """The next numbers (n, m) of some streams, which are counted on; all bits of them random."""
    for row, index in enumerate(indices):
        key = np.uint32(state[index, 0]), np.uint32(state[index, 0] >> np.uint64(32))
        count = state[index, 1]
        for column in range(drawn.shape[1]):
            first, second = threefry(key, (np.uint32(count), np.uint32(count >> np.uint64(32))))
            drawn[row, column] = np.uint64(first) | (np.uint64(second) << np.uint64(32))
            count += np.uint64(1)
        state[index, 1] = count
