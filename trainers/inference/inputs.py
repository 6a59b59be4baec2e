"""Observations from anywhere, checked against the space that a policy was trained on."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from trainers.common.errors import suggestion

Arrays = dict[str, NDArray[Any]]


def checked(
    observations: NDArray[Any] | Mapping[str, NDArray[Any]],
    space: gymnasium.spaces.Dict,
    ignored: Collection[str] = (),
) -> tuple[Arrays, bool]:
    """Observations with a leading axis B, in the types of their spaces.

    Args:
        observations: by name, each of one environment or with a leading axis; where there is only
            one observation, its array alone will do.
        space: of one environment.
        ignored: names that may be there, too.

    Returns:
        Arrays (B, ...) by name, and whether they came without the leading axis.

    Raises:
        ValueError: with everything that is wrong: names, shapes and types.
    """
    given = _by_name(observations, space)
    problems = _name_problems(given, space, ignored)
    arrays: Arrays = {}
    lengths: dict[str, int | None] = {}
    for name in (name for name in space.spaces if name in given):
        array = np.asarray(given[name])
        shape = space[name].shape or ()
        if array.shape not in (shape, (*array.shape[:1], *shape)):
            problems.append(
                f"{name!r}: of shape {array.shape}, where {shape} or (B, ...) of it is expected"
            )
        elif not _fits(array.dtype, space[name].dtype):
            problems.append(
                f"{name!r}: of type {array.dtype}, where {space[name].dtype} is expected"
            )
        else:
            lengths[name] = None if array.shape == shape else len(array)
            arrays[name] = array.astype(space[name].dtype, copy=False)
    if len(set(lengths.values())) > 1:
        each = ", ".join(f"{name!r}: {length or 'none'}" for name, length in lengths.items())
        problems.append(f"of different leading axes B ({each})")
    if problems:
        raise ValueError("observations: " + "; ".join(problems))
    is_single = None in lengths.values()
    return ({k: v[None] for k, v in arrays.items()} if is_single else arrays), is_single


def _by_name(
    observations: NDArray[Any] | Mapping[str, NDArray[Any]], space: gymnasium.spaces.Dict
) -> Mapping[str, NDArray[Any]]:
    if isinstance(observations, Mapping):
        return observations
    names = list(space.spaces)
    if len(names) != 1:
        raise ValueError(f"observations: a mapping by name is expected, of {', '.join(names)}")
    return {names[0]: observations}


def _name_problems(
    given: Mapping[str, Any], space: gymnasium.spaces.Dict, ignored: Collection[str]
) -> list[str]:
    missing = [f"{name!r} is missing" for name in space.spaces if name not in given]
    unknown = [
        f"{name!r} is unknown; {suggestion(name, space.spaces)}"
        for name in given
        if name not in space.spaces and name not in ignored
    ]
    return missing + unknown


def _fits(given: np.dtype[Any], expected: np.dtype[Any] | None) -> bool:
    """Whether numbers mean the same: codes of images are of their own type, floats of any."""
    if given == expected:
        return True
    return np.issubdtype(expected, np.floating) and given.kind in "fiu"
