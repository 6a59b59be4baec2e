"""Nested state as JSON and arrays, and back, with every type as it was; nothing is pickled."""

from __future__ import annotations

import math
from collections import OrderedDict
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
        ValueError: the skeleton holds an object of unknown kind.
        KeyError: an array is missing.
    """
    if isinstance(skeleton, list):
        return [unflatten(item, arrays) for item in skeleton]
    if not isinstance(skeleton, dict):
        return skeleton
    match skeleton:
        case {"dict": content}:
            return {key: unflatten(value, arrays) for key, value in content.items()}
        case {"items": content}:
            return {key: unflatten(value, arrays) for key, value in content}
        case {"ordered": content}:
            return OrderedDict((key, unflatten(value, arrays)) for key, value in content)
        case {"tuple": content}:
            return tuple(unflatten(item, arrays) for item in content)
        case {"float": text}:
            return float(text)
        case {"tensor": name, "dtype": dtype, "shape": shape}:
            return _restored_tensor(arrays[name], _TORCH_DTYPES[dtype], shape)
        case {"array": name, "dtype": dtype, "shape": shape}:
            return _restored_array(arrays[name], np.dtype(dtype), shape)
        case {"scalar": name, "dtype": dtype}:
            return _restored_array(arrays[name], np.dtype(dtype), [])[()]
        case _:
            raise ValueError(f"unknown kind of value in the state: {sorted(skeleton)}")


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
    return tensor.reshape(shape)


def _restored_array(stored: np.ndarray, dtype: np.dtype[Any], shape: list[int]) -> np.ndarray:
    array = _writable(stored)
    if array.dtype != dtype:
        array = array.view(dtype)
    return array.reshape(shape)


def _writable(array: np.ndarray) -> np.ndarray:
    return array if array.flags.writeable else array.copy()
