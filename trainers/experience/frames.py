"""Frames of a collection: each kept once, and encoded once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from trainers.networks.observations import is_frame, torch_dtype


class FrameStore:
    """Frames in the order they came, each once, and moved to the device once.

    The memory is reserved for the most there can be; on the CPU the operating system gives it page
    by page as frames arrive, so that frames which are shared cost nothing.

    Args:
        spaces: of the frames, by name.
        capacity: the most frames there can be.
        device: where they are kept.
    """

    def __init__(
        self,
        spaces: Mapping[str, gymnasium.Space[Any]],
        capacity: int,
        device: torch.device,
    ):
        self._tensors = {
            name: torch.empty(
                (capacity, *(space.shape or ())), dtype=torch_dtype(space.dtype), device=device
            )
            for name, space in spaces.items()
        }
        self.count = 0

    def add(
        self, observations: Mapping[str, NDArray[Any]], rows: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Keeps some rows of the observations; returns the frames' indices."""
        first, self.count = self.count, self.count + len(rows)
        for name, tensor in self._tensors.items():
            tensor[first : self.count].copy_(torch.from_numpy(observations[name][rows]))
        return np.arange(first, self.count)

    def tensors(self, first: int = 0) -> dict[str, torch.Tensor]:
        """All frames from the `first` on by name, (count - first, H, W, C), without a copy."""
        return {name: tensor[first : self.count] for name, tensor in self._tensors.items()}


def frame_spaces(space: gymnasium.spaces.Dict) -> dict[str, gymnasium.Space[Any]]:
    """The spaces of the images among the observations."""
    return {name: part for name, part in space.spaces.items() if is_frame(part)}
