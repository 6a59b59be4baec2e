"""Nested state as JSON and arrays, and back, with every type as it was; nothing is pickled."""

from __future__ import annotations

import itertools
import math
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch

# What safetensors stores as such; an array of any other type is stored as its bytes.
_STORED_AS_IS = frozenset(
    (
        *("bool", "uint8", "uint16", "uint32", "uint64", "int8", "int16", "int32", "int64"),
        *("float16", "float32", "float64"),
    )
)
_NUMERIC_KINDS = "biufc"
LARGEST_INTEGER = 2**63
"""From here on only random generators count."""

_TORCH_DTYPES = {
    str(value).removeprefix("torch."): value
    for value in vars(torch).values()
    if isinstance(value, torch.dtype)
}


def flatten(state: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """Take nested state apart into a JSON value and a flat dict of arrays.

    Numbers, strings and lists stand in the JSON as they are; everything else is an object with
    the name of its kind (`dict`, `items` for a dict with int keys, `tuple`, `tensor`, ...).

    Args:
        state: nested dict (keys str or int), OrderedDict, list and tuple of None, bool, int,
            float, str, dense torch tensors, numeric numpy arrays and numpy's own scalars.

    Returns:
        The JSON value (without NaN or infinity, so that any JSON reader takes it), and the arrays
        by name, contiguous and of types that safetensors knows. They may share memory with
        `state`.

    Raises:
        TypeError: something else is in the state; the message names its path.
    """
    arrays: dict[str, np.ndarray] = {}
    return _flatten(state, "state", arrays), arrays


def snapshot(state: Any, most_bytes: int) -> Any:
    """Copy nested state, so that nothing changes it any more; its tensors are on the CPU.

    Args:
        state: as `flatten` takes it.
        most_bytes: that its arrays may have.

    Returns:
        The copy; None where the arrays are larger.

    Raises:
        TypeError: see `flatten`.
    """
    skeleton, arrays = flatten(state)
    if sum(array.nbytes for array in arrays.values()) > most_bytes:
        return None
    return unflatten(skeleton, {name: array.copy() for name, array in arrays.items()})


def unflatten(skeleton: Any, arrays: dict[str, np.ndarray]) -> Any:  # noqa: PLR0911 one a kind
    """Put together what `flatten` took apart; the inverse of it.

    Args:
        skeleton: the JSON value.
        arrays: the arrays by name. Writable ones are used without a copy.

    Returns:
        The state. Tensors are on the CPU and need no gradient.

    Raises:
        ValueError: the skeleton holds an object of unknown kind, or an array has another size.
        KeyError: an array is missing.
    """
    if isinstance(skeleton, list):
        return [unflatten(item, arrays) for item in skeleton]
    if not isinstance(skeleton, dict):
        return skeleton
    match skeleton:
        case {"dict": dict(content)}:
            return {key: unflatten(value, arrays) for key, value in content.items()}
        case {"items": list(content)}:
            return dict(_pairs(content, arrays))
        case {"ordered": list(content)}:
            return OrderedDict(_pairs(content, arrays))
        case {"tuple": list(content)}:
            return tuple(unflatten(item, arrays) for item in content)
        case {"float": str(text)}:
            return float(text)
        case {"tensor": str(name), "dtype": str(dtype), "shape": list(shape)}:
            return _restored_tensor(arrays[name], _TORCH_DTYPES[dtype], shape)
        case {"array": str(name), "dtype": str(dtype), "shape": list(shape)}:
            return _restored_array(arrays[name], np.dtype(dtype), shape)
        case {"scalar": str(name), "dtype": str(dtype)}:
            return _restored_array(arrays[name], np.dtype(dtype), [])[()]
        case _:
            raise ValueError(f"unknown kind of value in the state: {sorted(skeleton)}")


def _pairs(content: list[Any], arrays: dict[str, np.ndarray]) -> Iterator[tuple[Any, Any]]:
    for key, value in content:
        if type(key) not in (int, str):
            raise ValueError(f"the key {key!r} is neither str nor int")
        yield key, unflatten(value, arrays)


def mismatch(given: Any, own: Any, path: str = "state") -> str | None:
    """Where a state is of another kind than one's own, and how; None: nowhere.

    Sizes may differ, and what only one of them has; where one's own is None, anything may be.

    Args:
        given: nested as `flatten` takes it.
        own: the same, of what is to take it over.
        path: of both.
    """
    if own is None:
        return None
    if _kind(given) != _kind(own):
        return f"{path} is {_kind(given)}, not {_kind(own)}"
    pairs: Iterable[tuple[Any, Any, Any]] = ()
    if isinstance(own, dict):
        pairs = ((key, given[key], own[key]) for key in own.keys() & given.keys())
    elif isinstance(own, list | tuple):
        pairs = zip(itertools.count(), given, own, strict=False)
    inner = (mismatch(theirs, ours, f"{path}.{key}") for key, theirs, ours in pairs)
    return next(filter(None, inner), None)


def _kind(value: Any) -> str:
    """The kind of a value, for people and to be compared."""
    if isinstance(value, torch.Tensor | np.ndarray):
        axes = "axis" if value.ndim == 1 else "axes"
        return f"an array of {value.ndim} {axes} of {value.dtype}".replace("torch.", "")
    if isinstance(value, tuple):
        return f"a tuple of {len(value)}"
    if isinstance(value, bool | np.bool_):
        return "true or false"
    if isinstance(value, int | float | np.number):
        is_large = isinstance(value, int) and abs(value) >= LARGEST_INTEGER
        return "a number beyond 64 bits" if is_large else "a number"
    if isinstance(value, dict):
        return "a mapping"
    return "a list" if isinstance(value, list) else type(value).__name__


def _flatten(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:  # noqa: PLR0911
    # By exact type: a subclass (np.float64 is a float, IntEnum an int) would come back as its base.
    kind = type(value)
    if value is None or kind in (bool, int, str):
        return value
    if kind is float:
        return value if math.isfinite(value) else {"float": repr(value)}
    if kind is list:
        return _flatten_sequence(value, path, arrays)
    if kind is tuple:
        return {"tuple": _flatten_sequence(value, path, arrays)}
    if kind in (dict, OrderedDict):
        return _flatten_dict(value, path, arrays)
    if isinstance(value, torch.Tensor):
        return _flatten_tensor(value, path, arrays)
    if kind is np.ndarray or isinstance(value, np.generic):
        return _flatten_array(value, path, arrays)
    raise TypeError(f"{path}: a value of type {kind.__module__}.{kind.__qualname__} can't be saved")


def _flatten_sequence(values: Any, path: str, arrays: dict[str, np.ndarray]) -> list[Any]:
    return [_flatten(value, f"{path}[{i}]", arrays) for i, value in enumerate(values)]


def _flatten_dict(values: dict[Any, Any], path: str, arrays: dict[str, np.ndarray]) -> Any:
    for key in values:
        if type(key) not in (str, int):
            raise TypeError(f"{path}: the key {key!r} is neither str nor int and can't be saved")
    pairs = [[key, _flatten(value, f"{path}.{key}", arrays)] for key, value in values.items()]
    if type(values) is OrderedDict:
        return {"ordered": pairs}
    if all(type(key) is str for key in values):
        return {"dict": dict(pairs)}
    return {"items": pairs}


def _flatten_tensor(tensor: torch.Tensor, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if tensor.layout != torch.strided or tensor.is_quantized:
        raise TypeError(f"{path}: only dense tensors can be saved, not {tensor.layout}")
    dense = tensor.detach().cpu().resolve_conj().resolve_neg().contiguous()
    dtype = str(dense.dtype).removeprefix("torch.")
    # NumPy lacks bfloat16 and the eight-bit floats: bytes serve every type alike.
    array = dense if dtype in _STORED_AS_IS else dense.reshape(-1).view(torch.uint8)
    return {"tensor": _add(array.numpy(), arrays), "dtype": dtype, "shape": list(dense.shape)}


def _flatten_array(
    value: np.ndarray | np.generic, path: str, arrays: dict[str, np.ndarray]
) -> dict[str, Any]:
    if value.dtype.kind not in _NUMERIC_KINDS:
        raise TypeError(f"{path}: numpy values of type {value.dtype} can't be saved")
    # Not np.ascontiguousarray: it gives a 0-d array an axis.
    array = np.asarray(value, order="C")
    if array.dtype.name not in _STORED_AS_IS or not array.dtype.isnative:
        array = np.frombuffer(array.tobytes(), np.uint8)
    name, dtype = _add(array, arrays), value.dtype.str
    if isinstance(value, np.generic):
        return {"scalar": name, "dtype": dtype}
    return {"array": name, "dtype": dtype, "shape": list(value.shape)}


def _add(array: np.ndarray, arrays: dict[str, np.ndarray]) -> str:
    # Numbers, because paths are not unique: the keys 0 and "0" read alike, and so do "a.b" and a.b.
    name = str(len(arrays))
    arrays[name] = array
    return name


def _restored_tensor(stored: np.ndarray, dtype: torch.dtype, shape: list[int]) -> torch.Tensor:
    tensor = torch.from_numpy(_writable(stored))
    if tensor.dtype != dtype:
        tensor = tensor.view(dtype)
    _check_shape(shape, tensor.numel())
    return tensor.reshape(shape)


def _restored_array(stored: np.ndarray, dtype: np.dtype[Any], shape: list[int]) -> np.ndarray:
    array = _writable(stored)
    if array.dtype != dtype:
        array = array.view(dtype)
    _check_shape(shape, array.size)
    return array.reshape(shape)


def _check_shape(shape: list[int], size: int) -> None:
    """Raises ValueError where so many values don't have a shape; -1 would be made to fit."""
    if not all(type(each) is int and each >= 0 for each in shape) or math.prod(shape) != size:
        raise ValueError(f"an array of {size} values can't have the shape {shape}")


def _writable(array: np.ndarray) -> np.ndarray:
    return array if array.flags.writeable else array.copy()
