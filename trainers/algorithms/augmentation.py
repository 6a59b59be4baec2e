"""Images changed at random, so that a network learns what does not matter."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from trainers.networks.observations import Observations, gather

# Of a batch. Clouds have one fewer, and no pixels.
IMAGE_DIMENSIONS = 4

Augmentation = Callable[[Observations], Observations]


def unchanged(observations: Observations) -> Observations:
    """No augmentation."""
    return observations


class RandomShift:
    """Shifts every image by up to some pixels (Kostrikov et al. 2020, arXiv:2004.13649).

    Images of one observation are shifted apart; what comes into view repeats the edge.

    Args:
        pixels: the furthest an image is shifted, along each axis.
        generator: the source of randomness.
    """

    def __init__(self, pixels: int, generator: torch.Generator):
        self._pixels, self._generator = pixels, generator

    def __call__(self, observations: Observations) -> Observations:
        """The same observations with other frames."""
        frames = {
            name: self._shifted(frames) if frames.ndim == IMAGE_DIMENSIONS else frames
            for name, frames in observations.frames.items()
        }
        return dataclasses.replace(observations, frames=frames)

    def _shifted(self, images: Tensor) -> Tensor:
        count, height, width, _ = images.shape
        rows, columns = self._sources(count, height), self._sources(count, width)
        chosen = torch.arange(count, device=images.device)[:, None, None]
        return gather(images, (chosen, rows[:, :, None], columns[:, None, :]))

    def _sources(self, count: int, length: int) -> Tensor:
        """From where along an axis each pixel of each image comes, (count, length)."""
        device, most = self._generator.device, self._pixels
        shift = torch.randint(-most, most + 1, (count, 1), generator=self._generator, device=device)
        return (torch.arange(length, device=device) + shift).clamp(0, length - 1)
