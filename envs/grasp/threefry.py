"""Random numbers from a counter: number i of a seed depends on nothing but i and the seed.

So rows of a batch can be filled in any order, by any number of threads, and come out the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.grasp.compiled import compiled

PARITY = np.uint32(0x1BD11BDA)


@compiled()
def _mixed(x: np.uint32, y: np.uint32, turn: int) -> tuple[np.uint32, np.uint32]:
    """One round: add, rotate by `turn` bits, exclusive or."""
    total = np.uint32(x + y)
    turned = np.uint32(np.uint32(y << np.uint32(turn)) | np.uint32(y >> np.uint32(32 - turn)))
    return total, np.uint32(turned ^ total)


@compiled()
def threefry(
    key: tuple[np.uint32, np.uint32], counter: tuple[np.uint32, np.uint32]
) -> tuple[np.uint32, np.uint32]:
    """Two random uint32 from a key and a counter of two uint32 each: Threefry-2x32, 13 rounds.

    Source: Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011,
    where 13 rounds pass all tests of BigCrush.
    """
    first, second = key
    third = np.uint32(first ^ second ^ PARITY)
    x, y = np.uint32(counter[0] + first), np.uint32(counter[1] + second)
    x, y = _mixed(x, y, 13)
    x, y = _mixed(x, y, 15)
    x, y = _mixed(x, y, 26)
    x, y = _mixed(x, y, 6)
    x, y = np.uint32(x + second), np.uint32(y + third + np.uint32(1))
    x, y = _mixed(x, y, 17)
    x, y = _mixed(x, y, 29)
    x, y = _mixed(x, y, 16)
    x, y = _mixed(x, y, 24)
    x, y = np.uint32(x + third), np.uint32(y + first + np.uint32(2))
    x, y = _mixed(x, y, 13)
    x, y = _mixed(x, y, 15)
    x, y = _mixed(x, y, 26)
    x, y = _mixed(x, y, 6)
    x, y = np.uint32(x + first), np.uint32(y + second + np.uint32(3))
    x, y = _mixed(x, y, 17)
    return x, y


@compiled()
def uniform(stream: NDArray[np.uint64], low: float, high: float) -> float:
    """The stream's next number, uniform in [low, high).

    Args:
        stream: (2,) the seed, and how many numbers were drawn, which is counted on.
        low: lower end.
        high: upper end.
    """
    seed, drawn = stream
    stream[1] = drawn + np.uint64(1)
    first, second = threefry(
        (np.uint32(seed), np.uint32(seed >> np.uint64(32))),
        (np.uint32(drawn), np.uint32(drawn >> np.uint64(32))),
    )
    # 27 and 26 bits make the 53 of a float64's mantissa.
    whole = (first >> np.uint32(5)) * 67108864.0 + (second >> np.uint32(6))
    return low + (high - low) * whole / 9007199254740992.0
