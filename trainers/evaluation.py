"""How good a policy is, on scenes it has never seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from curricula.samplers import ParameterValue
from envs.environment import Environment
from trainers.algorithm import Algorithm
from trainers.checkpoint import Loaded
from trainers.errors import UserError
from trainers.interaction import SUCCESS, Episodes, Interaction, concatenate
from trainers.observations import to_tensors
from trainers.plugins import Registries, load_registries
from trainers.policy import to_environment
from trainers.results import CONFIGURATION, find_checkpoint, run_folder
from trainers.session import build_curriculum, build_environment, build_factory
from trainers.settings import RunSettings, load_run

# Run files take seeds below this, so that no run was ever trained on an evaluation's scenes.
FIRST_SEED = 2**32
FIRST_ACTION, WHOLE_EPISODE = 0, 1


def evaluate(
    policy: str,
    *,
    episodes: int | None,
    seed: int,
    overrides: Sequence[str] = (),
    results_dir: Path = Path("results"),
) -> dict[str, Any]:
    """Evaluates a policy on the last lesson's task.

    Where the first action is to be right, as in grasping, it is judged by itself, and the whole
    episodes are played as in training. Elsewhere they are played by the deterministic policy.

    Args:
        policy: a run's folder or id, or a checkpoint's folder.
        episodes: how many, for the first actions and for the whole episodes each; None: what the
            environment is judged by.
        seed: of the scenes, which no training run has seen.
        overrides: `KEY=VALUE`s on top of the run's own configuration.
        results_dir: where a run is looked for by its id.

    Returns:
        What is known of: `episodes`, `seed`; of the deterministic policy's first action
        `first_action_success`, `collision_rate`, `position_error_m` and `yaw_error_deg`; and of
        the whole episodes `success`, the means `reward` and `episode_length`, and `reward_std`.

    Raises:
        UserError: there is no such policy, or it does not fit its configuration.
    """
    registries = load_registries()
    loaded = find_checkpoint(policy, results_dir)
    run = load_run(run_folder(loaded.path) / CONFIGURATION, overrides, registries)
    with _player(run, registries, loaded, seed, FIRST_ACTION) as player:
        count = episodes or player.interaction.env.evaluation_episodes
        first = _first_actions(player, count)
    with _player(run, registries, loaded, seed, WHOLE_EPISODE) as player:
        whole = _whole_episodes(player, count, deterministic=not first)
    return {"episodes": count, "seed": seed, **whole, **first}


def final_parameters(run: RunSettings) -> dict[str, ParameterValue]:
    """Environment parameters of the run's last lesson."""
    curriculum = build_curriculum(run)
    lesson = {} if curriculum is None else curriculum.final_parameters()
    return {**run.environment_parameters, **lesson}


@contextmanager
def _player(
    run: RunSettings, registries: Registries, loaded: Loaded, seed: int, part: int
) -> Iterator[_Player]:
    """The policy before scenes of its own for each part of the evaluation."""
    env = build_environment(run, seed=FIRST_SEED + 2 * seed + part)
    try:
        env.set_parameters(final_parameters(run))
        player = _Player(run, registries, env, seed)
        player.load(loaded.weights, str(loaded.path))
        yield player
    finally:
        env.close()


class _Player:
    """A policy before its environments."""

    def __init__(self, run: RunSettings, registries: Registries, env: Environment, seed: int):
        self.interaction = Interaction(env)
        self._generator = torch.Generator().manual_seed(seed)
        self._algorithm: Algorithm = run.trainer.cls(
            build_factory(run, registries, env),
            run.trainer.settings,
            self.interaction,
            self._generator,
            torch.device("cpu"),
        )

    def load(self, weights: dict[str, torch.Tensor], where: str) -> None:
        """Takes over weights."""
        policy: nn.Module = self._algorithm.policy
        try:
            policy.load_state_dict(weights)
        except RuntimeError as error:
            raise UserError(f"{where}: these weights do not fit the run's configuration") from error

    @torch.no_grad()
    def actions(self, *, deterministic: bool) -> NDArray[Any]:
        """Actions for the present observations."""
        env = self.interaction.env
        space = env.single_observation_space
        observations = to_tensors(self.interaction.observations, space, torch.device("cpu"))
        actions = self._algorithm.act(observations, deterministic=deterministic)
        return to_environment(actions, env.single_action_space)


def _whole_episodes(player: _Player, episodes: int, *, deterministic: bool) -> dict[str, Any]:
    """Plays until every environment has ended its share of episodes.

    Shares, because the first episodes to end would be the short ones, which are the good ones.
    """
    interaction = player.interaction
    count = interaction.env.num_envs
    share = np.full(count, episodes // count) + (np.arange(count) < episodes % count)
    parts: list[Episodes] = []
    ended = np.zeros(count, np.int64)
    interaction.reset()
    while (ended < share).any():
        step = interaction.step(player.actions(deterministic=deterministic))
        done = np.flatnonzero(step.terminated | step.truncated)
        finished = interaction.take_finished()
        parts.append(finished[ended[done] < share[done]])
        ended[done] += 1
    played = concatenate(parts)
    success = {"success": float(played.successes.mean())} if SUCCESS in played.measures else {}
    return {
        **success,
        "reward": float(played.rewards.mean()),
        "reward_std": float(played.rewards.std()),
        "episode_length": float(played.lengths.mean()),
    }


def _first_actions(player: _Player, episodes: int) -> dict[str, Any]:
    """Takes the deterministic policy's first action in every scene."""
    interaction = player.interaction
    parts: list[dict[str, NDArray[Any]]] = []
    for _ in range(-(-episodes // interaction.env.num_envs)):
        interaction.reset()
        *_, infos = interaction.env.step(player.actions(deterministic=True))
        if "position_error_m" not in infos.get("measures", {}):
            return {}
        parts.append(infos["measures"])
    values = {k: np.concatenate([part[k] for part in parts])[:episodes] for k in parts[0]}
    error = values["position_error_m"]
    return {
        "first_action_success": float(values["success"].mean()),
        "collision_rate": float(values["collision"].mean()),
        "position_error_m": {
            **_median_and_p95(error),
            **{axis: float(np.median(values[f"position_error_{axis}_m"])) for axis in "xyz"},
        },
        "yaw_error_deg": _median_and_p95(values["yaw_error_deg"]),
    }


def _median_and_p95(values: NDArray[np.float64]) -> dict[str, float]:
    return {"median": float(np.median(values)), "p95": float(np.percentile(values, 95))}
