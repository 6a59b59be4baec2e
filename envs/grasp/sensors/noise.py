"""Noise from a counter: number i of a seed depends on nothing but i and the seed.

Loops without a branch, which a compiler turns into vectors: hence polynomials where a library's
logarithm, sine and cosine would be called once for each number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.grasp.simulators.kernels.worlds import kernel
from envs.grasp.threefry import threefry

FAST = {"contract", "reassoc", "nsz", "arcp", "afn"}
# The second words of the counters, so that no two kinds of numbers have the same bits.
NORMALS, UNIFORMS, BITS = np.uint32(0), np.uint32(1), np.uint32(2)
MANTISSA_BITS = np.int32(23)
# Of the float32 next to sqrt(1/2): mantissas go from there to sqrt(2).
HALF_ROOT_BITS = np.int32(0x3F3504F3)
LN_2 = np.float32(np.log(2.0))
QUARTER_TURN = np.float32(np.pi / 2.0)
# (ln(1 + x) - x + x^2 / 2) / x^3 between those mantissas, a Chebyshev fit, the highest power first;
# sin(x) / x and cos(x) in powers of x^2 for x in +-pi/4 by Taylor, the lowest power first.
LOG = tuple(
    np.float32(value)
    for value in (
        0.09272214, -0.14118425, 0.14676397, -0.16592856, 0.19985128, -0.25000922, 0.3333341,
    )
)  # fmt: skip
SINE = tuple(np.float32(value) for value in (1.0, -1 / 6, 1 / 120, -1 / 5040))
COSINE = tuple(np.float32(value) for value in (1.0, -1 / 2, 1 / 24, -1 / 720, 1 / 40320))


@kernel()
def _minus_log(bits: np.uint32) -> np.float32:
    """-ln((bits + 1/2) / 2^32), from the exponent and the mantissa of its float32."""
    raw = np.float32(np.float32(bits) + np.float32(0.5)).view(np.int32)
    exponent = np.int32(np.int32(raw - HALF_ROOT_BITS) >> MANTISSA_BITS)
    x = np.int32(raw - np.int32(exponent << MANTISSA_BITS)).view(np.float32) - np.float32(1.0)
    series = LOG[0]
    series = series * x + LOG[1]
    series = series * x + LOG[2]
    series = series * x + LOG[3]
    series = series * x + LOG[4]
    series = series * x + LOG[5]
    series = series * x + LOG[6]
    square = x * x
    whole = np.float32(exponent - np.int32(32)) * LN_2
    return -(whole + (x - np.float32(0.5) * square + square * x * series))


@kernel(fastmath=FAST)
def fill_normals(seed: np.uint64, out: NDArray[np.float32]) -> None:
    """Fills an array of even length with standard normal numbers (Box and Muller, 1958).

    Args:
        seed: uint64, of which every one gives other numbers.
        out: (2 k,) whose halves are the two numbers of each pair.
    """
    half = np.uint32(len(out) // 2)
    key = (np.uint32(seed), np.uint32(seed >> np.uint64(32)))
    for i in range(half):
        bits, turn = threefry(key, (np.uint32(i), NORMALS))
        radius = np.sqrt(np.float32(2.0) * max(_minus_log(bits), np.float32(0.0)))
        # Two bits choose the quarter of the circle, the others the angle in it, +-1/8 turn.
        angle = np.float32(np.int32(np.uint32(turn << np.uint32(2)))) * np.float32(2.0**-32)
        angle = angle * QUARTER_TURN
        square = angle * angle
        sine = angle * (SINE[0] + square * (SINE[1] + square * (SINE[2] + square * SINE[3])))
        cosine = COSINE[0] + square * (
            COSINE[1] + square * (COSINE[2] + square * (COSINE[3] + square * COSINE[4]))
        )
        swapped = turn >> np.uint32(31) != 0
        sign = np.float32(1.0) - np.float32(2.0) * np.float32(
            (turn >> np.uint32(30)) & np.uint32(1)
        )
        out[i] = radius * sign * (sine if swapped else cosine)
        out[half + i] = radius * sign * (cosine if swapped else sine)


@kernel(fastmath=FAST)
def fill_bits(seed: np.uint64, first: int, out: NDArray[np.uint32]) -> None:
    """Fills an array of even length with random bits.

    Args:
        seed: uint64, of which every one gives other numbers.
        first: number of the first pair that is wanted.
        out: (2 k,) written, pair after pair.
    """
    key = (np.uint32(seed), np.uint32(seed >> np.uint64(32)))
    counter = np.uint32(first)
    for i in range(np.uint32(len(out) // 2)):
        one, other = threefry(key, (np.uint32(counter + i), BITS))
        out[np.uint32(2) * i], out[np.uint32(2) * i + np.uint32(1)] = one, other


@kernel(fastmath=FAST)
def fill_uniforms(seed: np.uint64, out: NDArray[np.float32]) -> None:
    """Fills an array of even length with numbers uniform in [0, 1), multiples of 2^-24.

    Args:
        seed: uint64, of which every one gives other numbers.
        out: (2 k,) whose halves are the two numbers of each pair.
    """
    half = np.uint32(len(out) // 2)
    key = (np.uint32(seed), np.uint32(seed >> np.uint64(32)))
    for i in range(half):
        first, second = threefry(key, (np.uint32(i), UNIFORMS))
        out[i] = np.float32(np.int32(first >> np.uint32(8))) * np.float32(2.0**-24)
        out[half + i] = np.float32(np.int32(second >> np.uint32(8))) * np.float32(2.0**-24)
