"""Gymnasium's spaces, as encoders and policies take them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from numpy.typing import NDArray

from encoders.spaces import DepthImage, PointCloud, RgbImage
from envs.environment import ObservationArrays

Channels = Literal["first", "last"] | None
"""Axis of images that has the channels; None: the first or the last, where it is the shortest."""
Path = tuple[Any, ...]
"""Keys of a Dict and places of a Tuple that lead to what is in them."""
OBSERVATION = "observation"
WRAP = "register an id that wraps the environment (docs/gymnasium.md shows how)"


@dataclass(frozen=True)
class Part:
    """One entry of an observation: what encoders are built on, and how to get there.

    Attributes:
        space: of one environment.
        convert: a batch (N, ...) as gymnasium has it -> a new array (N, *space.shape).
    """

    space: Box
    convert: Callable[[NDArray[Any]], NDArray[Any]]


class ObservationAdapter:
    """Batched observations as gymnasium has them -> dictionaries of vectors and images.

    Args:
        space: of one environment; of stacked observations the Tuple of them, the oldest first. What
            is in a Dict or a Tuple is called by the keys and places that lead there, as in `arm.0`;
            anything else becomes the only entry, `observation`. Depth and color images of
            `encoders.spaces` stay what they are.
        channels: of other images.
        frame_stack: observations in one, which are joined: images along their channels, vectors end
            to end.

    Attributes:
        space: what comes out; images have their channels last.

    Raises:
        ValueError: it holds what no encoder takes, what can't be joined, or two of one name.
    """

    def __init__(
        self, space: gymnasium.Space[Any], channels: Channels = None, frame_stack: int = 1
    ):
        self._frame_stack = frame_stack
        if frame_stack > 1:
            assert isinstance(space, gymnasium.spaces.Tuple)
            space = space.spaces[0]
        self._paths = _named(space)
        self._parts = {
            name: _part(name, _at(space, path), channels) for name, path in self._paths.items()
        }
        self.space = gymnasium.spaces.Dict(
            {name: _joined(name, part.space, frame_stack) for name, part in self._parts.items()}
        )

    def __call__(self, batch: Any) -> ObservationArrays:
        """(N, ...) of gymnasium -> by name, new arrays (N, ...)."""
        if self._frame_stack == 1:
            return self._entries(batch)
        frames = [self._entries(frame) for frame in batch]
        return {name: np.concatenate([f[name] for f in frames], axis=-1) for name in self._parts}

    def _entries(self, batch: Any) -> ObservationArrays:
        return {
            name: part.convert(_at(batch, self._paths[name])) for name, part in self._parts.items()
        }


class ActionAdapter:
    """Actions within a space -> new arrays of its type.

    Args:
        space: of one environment.

    Attributes:
        space: the same.

    Raises:
        ValueError: no policy acts in it.
    """

    def __init__(self, space: gymnasium.Space[Any]):
        self.space = space
        match space:
            case Box(shape=(_,)) if np.issubdtype(space.dtype, np.floating):
                pass
            case Discrete() | MultiDiscrete(shape=(_,)) | MultiBinary(shape=(_,)):
                pass
            case _:
                raise ValueError(
                    f"actions of the space {space} are not supported; a Box with floats, a "
                    "MultiDiscrete or a MultiBinary of one dimension, and Discrete are: "
                    f"{WRAP}"
                )

    def __call__(self, actions: NDArray[Any]) -> NDArray[Any]:
        """(N, ...) -> a new array (N, ...)."""
        return np.array(actions, self.space.dtype)


def flattens(space: gymnasium.Space[Any]) -> bool:
    """Whether gymnasium makes one vector of what a space holds."""
    try:
        return bool(space.is_np_flattenable)
    except NotImplementedError:  # a space of the environment's own
        return False


def _named(space: gymnasium.Space[Any]) -> dict[str, Path]:
    """Names of all that is in a space, and the paths that lead there."""
    paths: dict[str, Path] = {}
    for path in _paths(space):
        name = ".".join(map(str, path)) if path else OBSERVATION
        if name in paths:
            raise ValueError(
                f"observations: {list(paths[name])} and {list(path)} have the same name, {name!r}: "
                f"to call one another, {WRAP}"
            )
        paths[name] = path
    return paths


def _paths(space: gymnasium.Space[Any]) -> Iterator[Path]:
    match space:
        case gymnasium.spaces.Dict():
            keys: Any = space.spaces
        case gymnasium.spaces.Tuple():
            keys = range(len(space.spaces))
        case _:
            yield ()
            return
    for key in keys:
        yield from ((key, *inner) for inner in _paths(space[key]))


def _at(whole: Any, path: Path) -> Any:
    """What is at a path of a space, or of a batch of what it holds."""
    for key in path:
        whole = whole[key]
    return whole


def _joined(name: str, space: Box, count: int) -> Box:
    """The space of so many observations in one."""
    if count == 1:
        return space
    if isinstance(space, DepthImage | RgbImage | PointCloud):
        raise ValueError(
            f"frame_stack: observation {name!r} is of the space {space}, whose encoders take one "
            "at a time: leave frame_stack out, and see earlier ones by "
            "trainer.network_settings.memory (ppo and trpo)"
        )
    low, high = (np.concatenate([bound] * count, axis=-1) for bound in (space.low, space.high))
    return Box(low, high, dtype=space.dtype.type)


def _part(name: str, space: gymnasium.Space[Any], channels: Channels) -> Part:
    match space:
        case Discrete():
            return _one_hot(np.array([space.start]), np.array([space.n]))
        case MultiDiscrete():
            return _one_hot(space.start.ravel(), space.nvec.ravel())
        case MultiBinary():
            return _vector(Box(0, 1, space.shape, np.int8))
        case Box() if len(space.shape) <= 1:
            return _vector(space)
        case DepthImage() | RgbImage() | PointCloud():
            return Part(space, lambda batch: np.array(batch, space.dtype))
        case Box() if len(space.shape) == 3:
            return _image(name, space, channels)
    flatten = "set flatten_observations: true, which makes one vector of it, or "
    raise ValueError(
        f"observation {name!r}: no encoder takes the space {space}; a Box of vectors (n,) or "
        "images (height, width, channels), Discrete, MultiDiscrete, MultiBinary, and a Dict or a "
        f"Tuple of these are supported: {flatten if flattens(space) else ''}{WRAP}"
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


def _one_hot(first: NDArray[np.integer], count: NDArray[np.integer]) -> Part:
    """Choices from `first` on between `count` (k,) to one-hot vectors, end to end."""
    values = np.concatenate([np.arange(n) for n in count]) + np.repeat(first, count)
    choice = np.repeat(np.arange(len(count)), count)

    def convert(batch: NDArray[Any]) -> NDArray[Any]:
        chosen = np.asarray(batch).reshape(len(batch), len(count))
        return (chosen[:, choice] == values).astype(np.float32)

    return Part(Box(0.0, 1.0, values.shape, np.float32), convert)


def _image(name: str, space: Box, channels: Channels) -> Part:
    """Images in their own type, but float32 for any float, with their channels last."""
    axis = -3 if (channels or _shortest(name, space.shape)) == "first" else -1
    dtype = np.float32 if np.issubdtype(space.dtype, np.floating) else space.dtype
    with np.errstate(over="ignore"):
        low, high = (np.moveaxis(b.astype(dtype), axis, -1) for b in (space.low, space.high))
    return Part(
        Box(low, high, dtype=dtype),
        lambda batch: np.array(np.moveaxis(batch, axis, -1), dtype, order="C"),
    )


def _shortest(name: str, shape: tuple[int, ...]) -> Channels:
    """Which end of an image's shape is shorter than its other axes."""
    first, middle, last = shape
    if first < min(middle, last):
        return "first"
    if last < min(first, middle):
        return "last"
    raise ValueError(
        f"observation {name!r}: images of shape {shape} do not say which axis has the channels: "
        "set channels: first for (channels, height, width), or channels: last for (height, width, "
        "channels)"
    )
