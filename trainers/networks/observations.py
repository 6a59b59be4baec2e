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
_SIGNED = {torch.uint16: torch.int16, torch.uint32: torch.int32, torch.uint64: torch.int64}


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
    if isinstance(index, Tensor):
        # Whole images at a time, which takes a fifth of what indexing does pixel by pixel.
        return _signed(tensor).index_select(0, index).view(tensor.dtype)
    return _signed(tensor)[index].view(tensor.dtype)


def scatter(tensor: Tensor, index: Tensor, values: Tensor) -> None:
    """Replaces entries of a tensor of any type by values (B, ...)."""
    _signed(tensor)[index] = _signed(values).to(tensor.device)


def where(mask: Tensor, values: Tensor, others: Tensor) -> Tensor:
    """Values (B, ...) of any type where a mask (B,) is set, and others elsewhere."""
    beside = mask.view(-1, *(1,) * (values.ndim - 1))
    return torch.where(beside, _signed(values), _signed(others)).view(values.dtype)


def _signed(tensor: Tensor) -> Tensor:
    """The same memory as the signed twin of its type, which has all of torch's operations."""
    return tensor.view(_SIGNED.get(tensor.dtype, tensor.dtype))


def torch_dtype(dtype: np.dtype[Any] | type[Any] | None) -> torch.dtype:
    """Torch's name of a type of numbers."""
    return torch.from_numpy(np.empty(0, dtype)).dtype


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
