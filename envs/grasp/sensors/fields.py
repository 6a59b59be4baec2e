"""Random fields over a picture: white noise averaged over boxes, in 16 bits.

Boxes have sides of a power of two, so that a box is the sum of four of half its side. Where the
side is 1 a field is white.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from envs.grasp.sensors.noise import fill_bits
from envs.grasp.simulators.kernels.worlds import kernel

Words = NDArray[np.uint16]
Field = NDArray[np.int16]

# White noise is the sum of two random bytes, less its mean, times this: so large that what is
# rounded does not matter, so small that sums of four boxes never leave 16 bits.
FIELD_SCALE = 4
# In sigmas: so that even the least number is not under the quantile of 0.
BEYOND = 1.0
# So many words come from the generator at once.
TOGETHER = 4
FIELD_SIGMA = FIELD_SCALE * math.sqrt((256.0**2 - 1.0) / 6.0)


def power_of_two(pixels: float) -> int:
    """The power of two that is nearest in proportion, 1 at least."""
    return 1 << max(round(math.log2(max(pixels, 1.0))), 0)


@kernel()
def fill_white(
    seed: np.uint64, first: int, bits: NDArray[np.uint32], words: Words, white: Field
) -> None:
    """White noise from the first on, and the words that it is made of.

    Args:
        seed: of all numbers.
        first: a multiple of `TOGETHER`.
        bits: written.
        words: the same memory in halves, at least as many as there is white noise.
        white: written.
    """
    fill_bits(seed, first // TOGETHER, bits)
    _to_noise(words, white)


@kernel(counts=False)
def _to_noise(words: Words, white: Field) -> None:
    byte, eight, mean = np.uint16(255), np.uint16(8), np.int16(255)
    for i in range(np.uint32(len(white))):
        total = np.int16((words[i] & byte) + (words[i] >> eight))
        white[i] = np.int16(np.int16(total - mean) * np.int16(FIELD_SCALE))


@kernel()
def average(
    source: Field, first: int, last: int, stride: int, size: int, target: Field, other: Field
) -> tuple[Field, Field]:
    """A field of a side from one of a smaller side, with the same variance, and a free array.

    Args:
        source: whose length is at least `size` and `last - first` rows and columns more.
        first: its side.
        last: the side that is wanted.
        stride: from one row to the next.
        size: that is wanted.
        target: room.
        other: room; it may be the source, which else is kept.
    """
    side = first
    while side < last:
        count = size + (last - 2 * side) * (1 + stride)
        _average_boxes(source, side, stride, count, target)
        source, target, other = target, other, target
        side *= 2
    return source, target


@kernel(counts=False)
def _average_boxes(source: Field, side: int, stride: int, count: int, target: Field) -> None:
    """Boxes of twice the side: sums of four over two, which leaves the variance as it is."""
    right, below, both = np.uint32(side), np.uint32(side * stride), np.uint32(side * stride + side)
    for i in range(np.uint32(count)):
        above = np.int16(source[i] + source[i + right])
        total = np.int16(above + np.int16(source[i + below] + source[i + both]))
        target[i] = np.int16(total >> np.int16(1))


@kernel(counts=False)
def quantile(probability: float, side: int) -> float:
    """The number that a field is under with a probability, nearly; for 0 and 1 none and all are.

    White noise is triangular, and all averages are next to normal. For these see Shore, "Simple
    approximations for the inverse cumulative function, the density function and the loss integral
    of the normal distribution", Applied Statistics 1982.

    Args:
        probability: within 0 and 1.
        side: of the field.
    """
    tail = min(probability, 1.0 - probability)
    if side == 1:
        sigmas = math.sqrt(6.0) * (1.0 - math.sqrt(2.0 * tail)) + BEYOND * (tail <= 0.0)
    else:
        sigmas = 5.5556 * (1.0 - (tail / (1.0 - tail)) ** 0.1186)
    return FIELD_SIGMA * math.copysign(sigmas, probability - 0.5)
