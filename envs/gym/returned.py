"""What a gymnasium environment has to return; what is wrong with something else, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Tuple
from numpy.typing import NDArray

RESET = "(observation, info)"
STEP = "(observation, reward, terminated, truncated, info)"
SHOWN_CHARACTERS = 60
_REAL = "biuf"
"""Kinds of numpy's types that are real numbers."""


class WrongReturn(TypeError):  # noqa: N818 - the environment's error, not ours
    """An environment returned what it may not; the message says what it should."""


def checked_reset(space: gymnasium.Space[Any], returned: Any) -> tuple[Any, dict[str, Any]]:
    """What `reset` returned.

    Args:
        space: of observations.
        returned: by an environment.

    Raises:
        WrongReturn: it is something else.
    """
    _check_tuple("reset", returned, RESET)
    observation, info = returned
    check_observation(space, observation)
    _check_info(info)
    return observation, info


def checked_step(
    space: gymnasium.Space[Any], returned: Any
) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
    """What `step` returned; arguments and errors as `checked_reset`'s."""
    _check_tuple("step", returned, STEP)
    observation, reward, terminated, truncated, info = returned
    check_observation(space, observation)
    if type(reward) is not float and not _is_number(reward):
        raise _wrong("the reward", reward, "a number")
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if type(flag) is not bool and not (_is_number(flag) and flag in (0, 1)):
            raise _wrong(f"`{name}`", flag, "True or False")
    _check_info(info)
    return observation, reward, bool(terminated), bool(truncated), info


def checked_frame(returned: Any) -> NDArray[np.uint8]:
    """A copy of the picture in color that `render` returned; errors as `checked_reset`'s."""
    frame = _array(returned)
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise _wrong("what `render` returned", returned, "an array of uint8 (height, width, 3)")
    return frame.copy()


def check_observation(
    space: gymnasium.Space[Any], value: Any, name: str = "the observation"
) -> None:
    """Refuses what can't be taken for an observation; bounds are not looked at.

    Raises:
        WrongReturn: it has another shape, or its type does not become the space's without loss of
            meaning, as floats don't become integers.
    """
    match space:
        case Box():
            array = _array(value)
            if array.shape != space.shape or not np.can_cast(array.dtype, space.dtype, "same_kind"):
                raise _wrong(name, value, f"an array of {space.dtype} {space.shape}")
        case Dict():
            if not isinstance(value, Mapping):
                raise _wrong(name, value, f"a dictionary with the keys {list(space.spaces)}")
            for key, part in space.spaces.items():
                if key not in value:
                    keys = f"{list(space.spaces)}, and {key!r} is missing"
                    raise WrongReturn(f"{name} has the keys {list(value)}, and should have {keys}")
                check_observation(part, value[key], f"the observation {key!r}")
        case Tuple():
            if not isinstance(value, tuple | list) or len(value) != len(space.spaces):
                raise _wrong(name, value, f"a tuple of {len(space.spaces)}")
            for index, part in enumerate(space.spaces):
                check_observation(part, value[index], f"the observation {index}")
        case _ if not space.contains(value):
            raise _wrong(name, value, f"of {space}")


def _check_tuple(method: str, returned: Any, expected: str) -> None:
    if not isinstance(returned, tuple) or len(returned) != expected.count(",") + 1:
        raise _wrong(f"what `{method}` returned", returned, f"a tuple {expected}")


def _check_info(info: Any) -> None:
    if not isinstance(info, dict):
        raise _wrong("the info", info, "a dictionary")


def _is_number(value: Any) -> bool:
    array = _array(value)
    return array.ndim == 0 and array.dtype.kind in _REAL


def _array(value: Any) -> NDArray[Any]:
    """An array; of objects, where a value is none, such as lists of different lengths."""
    try:
        return np.asarray(value)
    except ValueError:
        return np.empty((), object)


def _wrong(what: str, value: Any, expected: str) -> WrongReturn:
    return WrongReturn(f"{what} is {_shown(value)}, and should be {expected}")


def _shown(value: Any) -> str:
    match value:
        case np.ndarray():
            return f"an array of {value.dtype} {value.shape}"
        case tuple():
            return f"a tuple of {len(value)}"
    text = repr(value)
    cut = text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]}..."
    return f"{cut} ({type(value).__name__})"
