"""Gymnasium's spaces, as encoders and policies take them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from encoders.spaces import DepthImage, PointCloud, RgbImage
from envs.environment import ObservationArrays

Channels = Literal["first", "last"] | None
"""Axis of images that has the channels; None: the last, where no other can be meant."""
OBSERVATION = "observation"
WRAP = "register an id that wraps the environment (docs/gymnasium.md shows how)"


@dataclass(frozen=True)
class Part:
    """One entry of an observation: what encoders are built on, and how to get there.

    Attributes:
        space: of one environment.
        convert: batch (N, ...) as gymnasium has it -> a new array (N, *space.shape).
    """

    space: Box
    convert: Callable[[NDArray[Any]], NDArray[Any]]


class ObservationAdapter:
    """Batched observations as gymnasium has them -> dictionaries of vectors and images.

    Args:
        space: of one environment. A Dict keeps its entries' names; anything else becomes the only
            entry, `observation`. Depth and color images of `encoders.spaces` stay what they are.
        channels: of other images.

    Attributes:
        space: what comes out; images have their channels last.

    Raises:
        ValueError: it holds what no encoder takes.
    """

    def __init__(self, space: gymnasium.Space[Any], channels: Channels = None):
        self._is_dict = isinstance(space, gymnasium.spaces.Dict)
        entries = space.spaces if isinstance(space, gymnasium.spaces.Dict) else {OBSERVATION: space}
        self._parts = {name: _part(name, entry, channels) for name, entry in entries.items()}
        self.space = gymnasium.spaces.Dict({k: part.space for k, part in self._parts.items()})

    def __call__(self, batch: Any) -> ObservationArrays:
        """(N, ...) of gymnasium -> by name, new arrays (N, ...)."""
        entries = batch if self._is_dict else {OBSERVATION: batch}
        return {name: part.convert(entries[name]) for name, part in self._parts.items()}


class ActionAdapter:
    """Actions of a policy -> actions of the environment.

    A Box stays as it is; whoever acts keeps to its bounds. A Discrete is counted from 0.

    Args:
        space: of one environment.

    Attributes:
        space: what policies act in.

    Raises:
        ValueError: no policy acts in it.
    """

    def __init__(self, space: gymnasium.Space[Any]):
        self.space = space
        self._start: Any = 0
        match space:
            case Box(shape=(_,)) if np.issubdtype(space.dtype, np.floating):
                pass
            case Discrete():
                self._start = space.start
                self.space = Discrete(int(space.n))
            case _:
                raise ValueError(
                    f"actions of the space {space} are not supported; a Box of one dimension with "
                    f"floats and Discrete are: {WRAP}"
                )

    def __call__(self, actions: NDArray[Any]) -> NDArray[Any]:
        """(N, ...) of the policy -> a new array (N, ...) of the environment."""
        return np.asarray(actions, self.space.dtype) + self._start


def flattens(space: gymnasium.Space[Any]) -> bool:
    """Whether gymnasium makes one vector of what a space holds."""
    try:
        return bool(space.is_np_flattenable)
    except NotImplementedError:  # a space of the environment's own
        return False


def _part(name: str, space: gymnasium.Space[Any], channels: Channels) -> Part:
    match space:
        case Discrete():
            return _one_hot(space)
        case Box() if len(space.shape) <= 1:
            return _vector(space)
        case DepthImage() | RgbImage() | PointCloud():
            return Part(space, lambda batch: np.array(batch, space.dtype))
        case Box() if len(space.shape) == 3:
            return _image(name, space, channels)
    flatten = "set flatten_observations: true, which makes one vector of it, or "
    raise ValueError(
        f"observation {name!r}: no encoder takes the space {space}; a Box of vectors (n,) or "
        "images (height, width, channels), Discrete, and a Dict of these are supported: "
        f"{flatten if flattens(space) else ''}{WRAP}"
    )


def _vector(space: Box) -> Part:
    """Vectors of any type, and single numbers, to float32."""
    size = int(np.prod(space.shape))
    with np.errstate(over="ignore"):  # a bound beyond float32 is none
        low, high = (b.astype(np.float32).reshape(size) for b in (space.low, space.high))
    return Part(
        Box(low, high, dtype=np.float32),
        lambda batch: np.array(batch, np.float32).reshape(len(batch), size),
    )


def _one_hot(space: Discrete) -> Part:
    values = np.arange(space.start, space.start + space.n)
    return Part(
        Box(0.0, 1.0, (int(space.n),), np.float32),
        lambda batch: (np.asarray(batch)[:, None] == values).astype(np.float32),
    )


def _image(name: str, space: Box, channels: Channels) -> Part:
    """Images in their own type, but float32 for any float, with their channels last."""
    height, width, depth = space.shape
    if channels is None and depth >= min(height, width):
        raise ValueError(
            f"observation {name!r}: images of shape {space.shape} do not say which axis has the "
            "channels: set channels: first for (channels, height, width), or channels: last for "
            "(height, width, channels)"
        )
    axis = -3 if channels == "first" else -1
    dtype = np.float32 if np.issubdtype(space.dtype, np.floating) else space.dtype
    with np.errstate(over="ignore"):
        low, high = (np.moveaxis(b.astype(dtype), axis, -1) for b in (space.low, space.high))
    return Part(
        Box(low, high, dtype=dtype),
        lambda batch: np.array(np.moveaxis(batch, axis, -1), dtype, order="C"),
    )
