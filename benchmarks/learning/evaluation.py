"""How both sides are judged: the deterministic policy's returns, off the clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.environment import Environment

# Training seeds are small; no episode of training is one of evaluation.
SEED = 1_000_000
Act = Callable[[Mapping[str, NDArray[Any]]], NDArray[Any]]
"""Observations of N environments by name -> the deterministic policy's actions (N, ...)."""


def returns(env: Environment, act: Act, episodes_each: int) -> NDArray[np.float64]:
    """Undiscounted returns of the first episodes in each of N environments, the same each time."""
    observations, _ = env.reset(seed=SEED)
    total, ended = np.zeros(env.num_envs), np.zeros(env.num_envs, np.int64)
    finished: list[float] = []
    while (ended < episodes_each).any():
        observations, reward, terminated, truncated, _ = env.step(act(observations))
        total += reward
        done = terminated | truncated
        finished += total[done & (ended < episodes_each)].tolist()
        ended += done
        total[done] = 0.0
    return np.array(finished)


class Referee:
    """Evaluates a policy now and then while it learns, and keeps the time that learning takes.

    Args:
        env: only for evaluation.
        interval: steps between two evaluations.
        episodes_each: of every environment, in each of them.

    Attributes:
        curve: steps and the mean return at each evaluation.
    """

    def __init__(self, env: Environment, interval: int, episodes_each: int = 1):
        self._env, self._interval, self._episodes_each = env, interval, episodes_each
        self._next = interval
        self._seconds, self._since = 0.0, 0.0
        self.curve: list[tuple[int, float]] = []

    def start(self) -> None:
        """Learning goes on from here."""
        self._since = time.perf_counter()

    def stop(self) -> float:
        """Learning stops here; returns the seconds that it has taken in all."""
        self._seconds += time.perf_counter() - self._since
        return self._seconds

    def look(self, step: int, act: Act) -> None:
        """Evaluates the policy where it is time to."""
        if step < self._next:
            return
        self.stop()
        self._next = step - step % self._interval + self._interval
        self.curve.append((step, float(returns(self._env, act, self._episodes_each).mean())))
        self.start()
