"""From settings to gymnasium's vector environment; what stands in the way is said plainly."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from envs.environment import EnvironmentFailure
from envs.gym.episodes import RepeatableEpisodes, StackedEpisodes
from envs.gym.processes import Message, ProcessVectorEnv, RestartLimits
from envs.gym.settings import GymSettings
from envs.gym.spaces import WRAP, flattens

GymVectorEnv = SyncVectorEnv[Any, Any] | ProcessVectorEnv
EXTRAS = {"gymnasium.envs.mujoco": "mujoco", "gymnasium.envs.box2d": "box2d"}
"""Packages of environments -> our optional dependencies that they need."""


def make_vector_env(
    settings: GymSettings,
    seed: int,
    *,
    with_infos: bool,
    prepare: Callable[[], Sequence[Message]],
) -> GymVectorEnv:
    """Makes N environments that are stepped together and reset in the step an episode ends in.

    Args:
        settings: which, and how many.
        seed: of all their episodes.
        with_infos: see `RepeatableEpisodes`.
        prepare: see `ProcessVectorEnv`.

    Raises:
        ValueError: it does not exist, lacks a package, refuses its arguments, or can't be stepped
            beside others.
        EnvironmentFailure: one of their processes died or hangs.
    """
    makers = [
        partial(_make_one, settings, seed, index, with_infos) for index in range(settings.num_envs)
    ]
    try:
        if settings.vectorization == "async":
            limits = RestartLimits(
                settings.max_lifetime_restarts,
                settings.restarts_rate_limit_n,
                settings.restarts_rate_limit_period_s,
            )
            return ProcessVectorEnv(makers, settings.id, settings.timeout_s, limits, prepare)
        # Whoever reads the observations copies them anyway.
        return SyncVectorEnv(makers, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)
    except (ValueError, EnvironmentFailure):
        raise
    except Exception as error:
        raise ValueError(
            f"{settings.num_envs} of {settings.id!r} can't be stepped together: "
            f"{type(error).__name__}: {error}"
        ) from error


def make(settings: GymSettings) -> gymnasium.Env[Any, Any]:
    """Makes a single environment; errors as `make_vector_env`."""
    name = settings.id
    try:
        env: gymnasium.Env[Any, Any] = gymnasium.make(
            name, max_episode_steps=settings.max_episode_steps, **settings.kwargs
        )
    except (gymnasium.error.UnregisteredEnv, gymnasium.error.DeprecatedEnv) as error:
        raise ValueError(
            f"id: gymnasium knows no environment {name!r}; {_nearest(name)}"
        ) from error
    except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
        raise ValueError(f"id: {name!r} lacks a package: {error}{_remedy(name)}") from error
    except (Exception, SystemExit) as error:  # foreign code: it can refuse in any way
        given = f" with kwargs {settings.kwargs}" if settings.kwargs else ""
        raise ValueError(
            f"{name!r} can't be made{given}: {type(error).__name__}: {error}"
        ) from error
    return _flattened(env) if settings.flatten_observations else env


def _flattened(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    space = env.observation_space
    if not flattens(space):
        raise ValueError(
            f"flatten_observations: gymnasium makes no vector of the space {space}: {WRAP}"
        )
    return gymnasium.wrappers.FlattenObservation(env)


def _make_one(
    settings: GymSettings, seed: int, index: int, with_infos: bool
) -> gymnasium.Env[Any, Any]:
    env, which = make(settings), (settings.id, seed, index)
    if settings.frame_stack > 1:
        return StackedEpisodes(env, *which, settings.frame_stack, with_infos=with_infos)
    return RepeatableEpisodes(env, *which, with_infos=with_infos)


def _nearest(name: str) -> str:
    close = difflib.get_close_matches(name, gymnasium.registry, n=3)
    if close:
        return "did you mean " + " or ".join(f"'{match}'" for match in close) + "?"
    return (
        "if a package of its own registers it, write MODULE:ID, and the module is imported first; "
        "gymnasium.pprint_registry() lists the others"
    )


def _remedy(name: str) -> str:
    spec = gymnasium.registry.get(name)
    entry = spec.entry_point if spec is not None else None
    for package, extra in EXTRAS.items():
        if isinstance(entry, str) and entry.startswith(package):
            return f"; install it: pip install 'ventosa[{extra}]'"
    return ""
