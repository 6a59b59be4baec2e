"""Steps per second of the grasp environment under random actions: all rewards, contacts, images."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial

import numpy as np

from benchmarks.speed.figures import FAST, MODES, PYBULLET, Case, Figure
from benchmarks.speed.timing import Samples, interleave, rate
from envs.grasp.env import make_vector_env
from envs.grasp.settings import Camera, GraspSettings
from envs.grasp.vector_env import GraspVectorEnv
from rewards.plugin import ventosa_rewards

WHAT = "environment steps"
EPISODE_STEPS = GraspSettings().episode_steps

Team = tuple[str, int]
"""A simulator and a number of environments."""


def measure(size: int, num_envs: Sequence[int], repeats: int, seconds: float) -> list[Figure]:
    """Measures `fast` with each number of environments, and PyBullet with the first.

    Args:
        size: side of the images in pixels.
        num_envs: how many environments are stepped together.
        repeats: rounds.
        seconds: of each measurement.
    """
    figures = []
    for mode in MODES:
        first, *more = num_envs
        teams = [(FAST, first), (PYBULLET, first), *((FAST, n) for n in more)]
        found = _race(size, mode, teams, repeats, seconds)
        figures += [
            Figure(Case(WHAT, size, mode, n), simulator, Samples(tuple(rates)))
            for (simulator, n), rates in found.items()
        ]
    return figures


def _race(
    size: int, mode: str, teams: Sequence[Team], repeats: int, seconds: float
) -> dict[Team, list[float]]:
    """Steps per second of each team, round by round."""
    with ExitStack() as stack:
        measures = {}
        for simulator, n in teams:
            env = make_vector_env(
                n,
                rewards=dict.fromkeys(ventosa_rewards(), 1.0),
                cameras={"depth": Camera(type="depth", width=size, height=size)},
                frame_grab=MODES[mode],
                simulator=simulator,
            )
            stack.callback(env.close)
            env.reset()
            play = partial(_play, env, np.random.default_rng(0))
            play()  # compiles
            measures[simulator, n] = partial(rate, play, seconds)
        return interleave(measures, repeats)


def _play(env: GraspVectorEnv, rng: np.random.Generator) -> int:
    """Random actions everywhere, as many as an episode has; returns the steps taken."""
    for _ in range(EPISODE_STEPS):
        env.step(rng.uniform(-1.0, 1.0, (env.num_envs, 4)))
    return EPISODE_STEPS * env.num_envs
