"""Stable-Baselines3 on this project's environments. Needs the extra `bench`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from envs.environment import Environment
from trainers.common.timers import timed
from trainers.networks.observations import is_image

Indices = int | Iterable[int] | None
Arrays = NDArray[Any] | dict[str, NDArray[Any]]


class PeerVecEnv(VecEnv):
    """N environments as Stable-Baselines3 takes them; nothing is copied that need not be.

    A single observation is handed out as it is, several as a dictionary. Images come channels
    first, as a view, which spares Stable-Baselines3 from transposing them; it divides those of
    `uint8` by 255 and no others, so depth should be of `encoding: uint8`.

    Args:
        env: the environments; closed with this.
    """

    def __init__(self, env: Environment):
        self._env, self._actions = env, np.empty(0)
        spaces = {name: _space(part) for name, part in env.single_observation_space.items()}
        self._only = next(iter(spaces)) if len(spaces) == 1 else None
        space = gymnasium.spaces.Dict(spaces) if self._only is None else spaces[self._only]
        super().__init__(env.num_envs, space, env.single_action_space)

    def reset(self) -> Arrays:
        """Begins an episode everywhere."""
        observations, _ = self._env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return self._arrays(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keeps the actions (N, ...) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Arrays, NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Takes the actions; the infos say how episodes ended, and what was seen last."""
        with timed("environment"):
            observations, reward, terminated, truncated, infos = self._env.step(self._actions)
        done = terminated | truncated
        of_each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            final = self._arrays(infos["final_obs"])
            for i in np.flatnonzero(done).tolist():
                of_each[i] = {
                    "terminal_observation": _row(final, i),
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                }
        return self._arrays(observations), reward.astype(np.float32), done, of_each

    def close(self) -> None:
        """Ends the environments."""
        self._env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute, the same for all environments."""
        return [getattr(self._env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, *_: Any, **__: Any) -> None:
        """Not there: the environments are one object."""
        raise NotImplementedError("the environments are one object: there is none to ask or tell")

    env_method = set_attr

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> Sequence[bool]:
        """None of them is."""
        return [False for _ in self._get_indices(indices)]

    def _arrays(self, observations: Mapping[str, NDArray[Any]]) -> Arrays:
        arrays = {
            name: np.moveaxis(values, -1, 1) if values.ndim == 4 else values
            for name, values in observations.items()
        }
        return arrays if self._only is None else arrays[self._only]


def _space(space: gymnasium.Space[Any]) -> gymnasium.Space[Any]:
    """The space of one observation with the channels of images first."""
    if isinstance(space, Box) and is_image(space):
        low, high = np.moveaxis(space.low, -1, 0), np.moveaxis(space.high, -1, 0)
        return Box(low, high, dtype=space.dtype)
    return space


def _row(arrays: Arrays, row: int) -> Arrays:
    if isinstance(arrays, dict):
        return {name: values[row] for name, values in arrays.items()}
    return arrays[row]
