"""Environment parameters of any gymnasium environment: attributes that it declares, or has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from curricula.samplers import ParameterValue, draw

PARAMETER_NAMES = "parameter_names"


class AttributeParameters:
    """Parameters of one environment, drawn anew for each of its episodes.

    The outermost of its wrappers, or the environment itself, that has `parameter_names` says by
    that which of its attributes they are. Where none has, they are the numbers among the attributes
    of the environment itself, but for those with an underscore in front.

    Attributes:
        names: of the parameters.
        given: numbers or samplers for the episodes that begin from now on, by name.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]):
        declared = _declared(env)
        self._owner: Any = env.unwrapped if declared is None else declared[0]
        self.names = _numbers(self._owner) if declared is None else declared[1]
        self.given: Mapping[str, ParameterValue] = {}

    def draw(self, run_seed: int, index: int, episode: int) -> dict[str, float]:
        """One value of each parameter that is given; arguments as `episode_seed`'s."""
        if not self.given:
            return {}  # to make a generator takes longer than many a step
        # One number more than the episode's own stream has, which is thus another.
        seeds = np.random.SeedSequence(run_seed, spawn_key=(index, episode, 0))
        rng = np.random.default_rng(seeds)
        return {name: float(draw(value, rng, 1)[0]) for name, value in self.given.items()}

    def apply(self, values: Mapping[str, float]) -> None:
        """Gives the attributes values; a whole one as int where the attribute is one."""
        for name, value in values.items():
            whole = isinstance(getattr(self._owner, name, None), Integral) and value.is_integer()
            setattr(self._owner, name, int(value) if whole else value)


def gather(values: list[dict[str, float]]) -> dict[str, NDArray[np.float64]]:
    """Values (N,) of N environments' parameters; NaN where one is not set."""
    names = dict.fromkeys(name for each in values for name in each)
    return {name: np.array([each.get(name, math.nan) for each in values]) for name in names}


def pick(gathered: Mapping[str, NDArray[np.float64]], index: int) -> dict[str, float]:
    """One environment's of the values that `gather` returned."""
    values = {name: float(of_all[index]) for name, of_all in gathered.items()}
    return {name: value for name, value in values.items() if not math.isnan(value)}


def _declared(env: gymnasium.Env[Any, Any]) -> tuple[Any, frozenset[str]] | None:
    layer: Any = env
    while True:
        if hasattr(layer, PARAMETER_NAMES):
            return layer, frozenset(getattr(layer, PARAMETER_NAMES))
        if layer is env.unwrapped:
            return None
        layer = layer.env


def _numbers(env: Any) -> frozenset[str]:
    of_classes = [vars(cls) for cls in type(env).__mro__]
    return frozenset(
        name
        for attributes in (*of_classes, vars(env))
        for name, value in attributes.items()
        if not name.startswith("_") and isinstance(value, Real) and not isinstance(value, bool)
    )
