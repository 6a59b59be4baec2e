"""Observations on the learner's side: tensors, with each distinct frame once.

Images and point clouds are *frames*: many steps may share one, so they are kept apart and referred
to by index. Vectors change every step and are kept as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from encoders.spaces import PointCloud
from trainers.networks.recurrent import Sequences

IMAGE_DIMENSIONS = 3


@dataclass(frozen=True)
class Observations:
    """B observations.

    Attributes:
        frames: by name, images (U, H, W, C) or clouds (U, P, 4) in their own type.
        vectors: by name, (B, n).
        frame_index: (B,) which of the U frames belongs to each; None: U = B, in this order.
        sequences: which of them follow each other, and the hidden state before; None: each is the
            first of its episode. Only networks with memory ask.
    """

    frames: dict[str, Tensor]
    vectors: dict[str, Tensor]
    frame_index: Tensor | None = None
    sequences: Sequences | None = None


def is_frame(space: gymnasium.Space[Any]) -> bool:
    """Whether observations of a space are images or point clouds."""
    return is_image(space) or isinstance(space, PointCloud)


def is_image(space: gymnasium.Space[Any]) -> bool:
    """Whether observations of a space are images."""
    return space.shape is not None and len(space.shape) == IMAGE_DIMENSIONS


def to_tensors(
    observations: Mapping[str, NDArray[Any]],
    space: gymnasium.spaces.Dict,
    device: torch.device,
    rows: NDArray[np.int64] | None = None,
) -> Observations:
    """Observations as an environment gives them, or some rows of them, as tensors."""
    frames: dict[str, Tensor] = {}
    vectors: dict[str, Tensor] = {}
    for name, values in observations.items():
        chosen = values if rows is None else values[rows]
        tensor = torch.from_numpy(np.ascontiguousarray(chosen)).to(device)
        (frames if is_frame(space[name]) else vectors)[name] = tensor
    return Observations(frames, vectors)


def gather(tensor: Tensor, index: Tensor | tuple[Tensor, ...]) -> Tensor:
    """Entries of a tensor of any type."""
    # torch indexes uint16 through its signed twin, which has all the operations.
    if tensor.dtype == torch.uint16:
        return tensor.view(torch.int16)[index].view(torch.uint16)
    return tensor[index]


def frames_differ(
    first: Mapping[str, NDArray[Any]],
    second: Mapping[str, NDArray[Any]],
    names: Iterable[str],
    rows: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Whether any of the frames of these names differ between two batches, at some rows."""
    differ = np.zeros(len(rows), bool)
    for name in names:
        unequal = first[name][rows] != second[name][rows]
        differ |= unequal.any(axis=tuple(range(1, unequal.ndim)))
    return differ
