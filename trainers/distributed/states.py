"""The state of a run from those of its processes, and back.

Which of a state's arrays have an entry for each environment is declared beside what has the state,
as a tree of axes: `{"reward": 0, "env": {"actions": 1}}` says that environments are the first axis
of whatever `reward` holds and the second of `env.actions`. All else is alike in all processes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainers.common.share import Share

Axes = Mapping[str, Any]
"""An axis, or another such tree, by the names of a state's parts."""
EACH = "each"
"""In the place of an axis: what is kept as each process has it, and is of use to as many alone."""


def joined(states: Sequence[Mapping[str, Any]], axes: Axes) -> dict[str, Any]:
    """The state of all environments.

    Args:
        states: those of the processes, by rank; of all but the first what is `differing`.
        axes: of the environments. What comes before the second axis is time, whose latest entry is
            the last: where there is more of it in one state, it is 0 in the others.
    """
    return {name: _joined([state[name] for state in states], axes.get(name)) for name in states[0]}


def differing(state: Mapping[str, Any], axes: Axes) -> dict[str, Any]:
    """What of a state is not alike in all processes; the rest is None."""
    return {name: _differing(value, axes.get(name)) for name, value in state.items()}


def on_cpu(value: Any) -> Any:
    """The same with tensors on the CPU, in mappings, lists and tuples."""
    match value:
        case Tensor():
            return value.cpu()
        case Mapping():
            return {name: on_cpu(part) for name, part in value.items()}
        case list() | tuple():
            return type(value)(map(on_cpu, value))
    return value


def divided(state: Mapping[str, Any], axes: Axes, share: Share) -> dict[str, Any]:
    """One process's share of a state of all environments.

    Raises:
        ValueError: it was saved with another number of environments.
    """
    return {name: _divided(value, axes.get(name), share) for name, value in state.items()}


def _joined(values: Sequence[Any], axes: Any) -> Any:
    first = values[0]
    if axes is None or first is None:
        return first
    if axes == EACH:
        return list(values)
    if isinstance(first, Mapping):
        inner = axes if isinstance(axes, Mapping) else dict.fromkeys(first, axes)
        return joined(values, inner)
    arrays = [np.asarray(value) for value in values]
    longest = max(len(array) for array in arrays)
    if axes:
        arrays = [_padded(array, longest) for array in arrays]
    whole = np.concatenate(arrays, axis=axes)
    return torch.from_numpy(whole) if isinstance(first, Tensor) else whole


def _differing(value: Any, axes: Any) -> Any:
    if isinstance(axes, Mapping) and isinstance(value, Mapping):
        return differing(value, axes)
    return None if axes is None else value


def _divided(value: Any, axes: Any, share: Share) -> Any:
    if axes is None or value is None:
        return value
    if axes == EACH:
        count = len(value) if isinstance(value, list) else 1
        if count != share.total // share.count:
            raise ValueError(
                f"its replay buffers are those of {count} ranks, and there are "
                f"{share.total // share.count}: start as many"
            )
        return value[share.first // share.count]
    if isinstance(value, Mapping):
        inner = axes if isinstance(axes, Mapping) else dict.fromkeys(value, axes)
        return divided(value, inner, share)
    if value.shape[axes] not in (share.total, 0):
        raise ValueError(f"it was saved with {value.shape[axes]} environments, not {share.total}")
    return value[(slice(None),) * axes + (slice(share.first, share.first + share.count),)]


def _padded(array: np.ndarray, length: int) -> np.ndarray:
    missing = np.zeros((length - len(array), *array.shape[1:]), array.dtype)
    return np.concatenate([missing, array])
