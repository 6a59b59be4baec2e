"""Gymnasium's spaces as plain data, for policies that are used without their environment."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from numpy.typing import NDArray

from encoders.cameras import Pinhole, Sampling
from encoders.spaces import DepthImage, PointCloud, RgbImage

Plain = dict[str, Any]
LARGEST_IMAGE, LARGEST_VECTOR = 2**26, 2**20
"""Values of what has several axes, and of what has one: a shape is not to take all memory."""


def space_to_plain(space: gymnasium.Space[Any]) -> Plain:  # noqa: PLR0911 one a kind
    """A space as JSON can have it; bounds that are all the same become one number.

    Raises:
        ValueError: it is of another kind than `space_from_plain` knows.
    """
    match space:
        case gymnasium.spaces.Dict():
            entries = {name: space_to_plain(part) for name, part in space.spaces.items()}
            return {"type": "dict", "entries": entries}
        case Discrete():
            return {"type": "discrete", "n": int(space.n), "start": int(space.start)}
        case MultiDiscrete(shape=(_,)):
            return {
                "type": "multi_discrete",
                "nvec": space.nvec.tolist(),
                "start": space.start.tolist(),
            }
        case MultiBinary(shape=(count,)):
            return {"type": "multi_binary", "n": count}
        case DepthImage():
            height, width, _ = space.shape
            return {
                "type": "depth_image",
                "height": height,
                "width": width,
                "range_m": list(space.range_m),
                "encoding": space.encoding,
                "pinhole": _fields(space.pinhole),
                "sampling": _fields(space.sampling),
            }
        case RgbImage():
            return {
                "type": "rgb_image",
                "height": space.shape[0],
                "width": space.shape[1],
                "sampling": _fields(space.sampling),
            }
        case PointCloud():
            return {
                "type": "point_cloud",
                "points": space.shape[0],
                "frame": space.frame,
                "middle_m": list(space.middle_m),
            }
        case Box():
            return {
                "type": "box",
                "low": _bound_to_plain(space.low),
                "high": _bound_to_plain(space.high),
                "shape": list(space.shape),
                "dtype": np.dtype(space.dtype).name,
            }
    raise ValueError(f"the space {space} can't be written: it is of an unknown kind")


def space_from_plain(plain: Plain) -> gymnasium.Space[Any]:  # noqa: PLR0911 one a kind
    """The space that `space_to_plain` wrote.

    Raises:
        ValueError: the data are of no kind of space, or of one too large.
        KeyError: something is missing in them.
        TypeError, OverflowError, AttributeError, AssertionError: something in them is of another
            type, or out of bounds.
    """
    fields = {key: value for key, value in plain.items() if key != "type"}
    match plain["type"]:
        case "dict":
            if not fields["entries"]:
                raise ValueError("a space of no observations")
            # As pairs: gymnasium would sort a dictionary, and networks concatenate in this order.
            return gymnasium.spaces.Dict(
                [(name, space_from_plain(part)) for name, part in fields["entries"].items()]
            )
        case "discrete":
            _check_shape([fields["n"]])
            return Discrete(fields["n"], start=fields["start"])
        case "multi_discrete":
            _check_shape([len(fields["nvec"])])
            _check_shape([sum(fields["nvec"])])
            return MultiDiscrete(fields["nvec"], start=fields["start"])
        case "multi_binary":
            _check_shape([fields["n"]])
            return MultiBinary(fields["n"])
        case "depth_image":
            return _depth_image(fields)
        case "rgb_image":
            _check_shape([fields["height"], fields["width"], 3])
            return RgbImage(**{**fields, "sampling": _sampling(fields.get("sampling"))})
        case "point_cloud":
            return PointCloud(**{**fields, "middle_m": tuple(fields["middle_m"])})
        case "box":
            return _box(fields)
    raise ValueError(f"a space of the unknown type {plain['type']!r}")


def _fields(geometry: Pinhole | Sampling | None) -> Plain | None:
    return None if geometry is None else asdict(geometry)


def _sampling(fields: Plain | None) -> Sampling | None:
    return None if fields is None else Sampling(**fields)


def _check_shape(shape: list[int]) -> None:
    """Raises ValueError where a shape has no values, or more than there may be."""
    largest = LARGEST_IMAGE if len(shape) > 1 else LARGEST_VECTOR
    if not all(type(size) is int and size > 0 for size in shape) or math.prod(shape) > largest:
        raise ValueError(f"a space of the shape {shape}: sizes are from 1 on, in all {largest}")


def _box(fields: Plain) -> Box:
    dtype, shape = np.dtype(str(fields["dtype"])), fields["shape"]
    _check_shape(shape)
    low, high = (_bound_from_plain(fields[key], dtype, tuple(shape)) for key in ("low", "high"))
    if dtype.kind not in "biuf" or not (low <= high).all():
        raise ValueError(f"a space of {dtype} from {low.min()} to {high.max()}")
    return Box(low, high, dtype=dtype.type)


def _depth_image(fields: Plain) -> DepthImage:
    _check_shape([fields["height"], fields["width"]])
    pinhole = fields.get("pinhole") and Pinhole(**fields["pinhole"])
    # Of policies from before cameras had a centre: square pixels, and the axis in the middle.
    if focal_px := fields.pop("focal_length_px", None):
        pinhole = Pinhole(focal_px, focal_px, fields["width"] / 2, fields["height"] / 2)
    sampling = _sampling(fields.get("sampling"))
    known = {"range_m": tuple(fields["range_m"]), "pinhole": pinhole, "sampling": sampling}
    return DepthImage(**{**fields, **known})


def _bound_to_plain(bound: NDArray[Any]) -> Any:
    """One number or text (`inf`) for all, or a list of them."""
    values = [value if np.isfinite(value) else str(value) for value in bound.ravel().tolist()]
    return values[0] if len(set(values)) == 1 else values


def _bound_from_plain(plain: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    # Integers stay integers: 2^64 - 1 is no float64.
    kind = int if np.issubdtype(dtype, np.integer) else float
    values = plain if isinstance(plain, list) else [plain]
    if wrong := [value for value in values if not _is_bound(value)]:
        raise ValueError(f"a bound is {wrong[0]!r}")
    if isinstance(plain, list):
        return np.array([kind(value) for value in plain], dtype).reshape(shape)
    return np.full(shape, kind(plain), dtype)


def _is_bound(value: Any) -> bool:
    return value in ("inf", "-inf") or type(value) in (int, float)
