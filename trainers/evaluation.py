"""How good a policy is, on scenes it has never seen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from curricula.samplers import ParameterValue
from envs.environment import Environment
from envs.evaluation import EvaluationReport, PhysicalCheck
from trainers.algorithms.base import Algorithm
from trainers.common.errors import UserError
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import SUCCESS, EpisodeBatch, concatenate
from trainers.networks.actions import to_environment
from trainers.networks.observations import to_tensors
from trainers.networks.recurrent import Sequences
from trainers.runfile.registry import Registries, load_registries
from trainers.runfile.settings import RunSettings, load_run
from trainers.saving.checkpoint import Loaded
from trainers.saving.evaluation_folder import EVALUATION, EvaluationFolder
from trainers.saving.run_folder import CONFIGURATION, find_checkpoint, run_folder
from trainers.session import build_curriculum, build_environment, build_factory

# Run files take seeds below this, so that no run was ever trained on an evaluation's scenes.
FIRST_SEED = 2**32
FIRST_ACTION, WHOLE_EPISODE = 0, 1
COLLISION, POSITION_ERROR = "collision", "position_error_m"


def evaluate(
    policy: str,
    *,
    episodes: int | None,
    seed: int,
    overrides: Sequence[str] = (),
    results_dir: Path = Path("results"),
    pick: bool = False,
    window: bool = False,
    render: str | None = None,
) -> dict[str, Any]:
    """Evaluates a policy on the last lesson's task.

    Where the first action is to be right, as in grasping, it is judged by itself, and the whole
    episodes are played as at the end of training: with actions that are drawn, or bear what
    exploration noise was left. Elsewhere they are played by the deterministic policy.

    Args:
        policy: a run's folder or id, or a checkpoint's folder.
        episodes: how many, for the first actions and for the whole episodes each; None: what the
            environment is judged by.
        seed: of the scenes, which no training run has seen.
        overrides: `KEY=VALUE`s on top of the run's own configuration.
        results_dir: where a run is looked for by its id.
        pick: try the first actions out in the environment's physical check.
        window: show that check as it goes.
        render: the folder for pictures; empty for `evaluation` in the run's own; None for none.

    Returns:
        What is known of: `episodes`, `seed`; of the deterministic policy's first action
        `first_action_success`, `first_action_collision_rate`, `position_error_m`, `yaw_error_deg`,
        and, after `pick`, `pick_rate` and the shares of `pick_failures`; and of the whole episodes
        `success`, `collision_rate` (the share of episodes with an undesired collision), the means
        `reward` and `episode_length`, and `reward_std`.

    Raises:
        UserError: there is no such policy, it does not fit its configuration, or what is asked for
            can't be had.
    """
    registries = load_registries()
    loaded = find_checkpoint(policy, results_dir)
    folder = run_folder(loaded.path)
    run = load_run(folder / CONFIGURATION, overrides, registries)

    playing = partial(_player, run, registries, loaded, seed)
    with playing(FIRST_ACTION) as player, ExitStack() as stack:
        env, check, album, gallery = player.env_runner.env, None, None, None
        count = episodes or env.evaluation_episodes
        if pick:
            with _asked_for("--pick"):
                check = stack.enter_context(closing(env.evaluator().physical_check(window=window)))
        if render is not None:
            with _asked_for("--render"):
                album = env.evaluator().pictures()
            gallery = EvaluationFolder(
                Path(render) if render else folder / EVALUATION, album.file_names
            )
        first = _first_actions(player, count, check, album)
    with playing(WHOLE_EPISODE) as player:
        whole = _whole_episodes(player, count, deterministic=not first)
    report = {"episodes": count, "seed": seed, **whole, **first}
    if album is not None and gallery is not None:
        gallery.write(report, album.files())
    return report


@contextmanager
def _asked_for(option: str) -> Iterator[None]:
    """What can't be had of what an option asks for is the user's mistake."""
    try:
        yield
    except ValueError as error:
        raise UserError(f"{option}: {error}") from error


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
        self.env_runner = EnvRunner(env)
        self._generator = torch.Generator().manual_seed(seed)
        self._algorithm: Algorithm = run.trainer.cls(
            build_factory(run, registries, env),
            run.trainer.settings,
            self.env_runner,
            self._generator,
            torch.device("cpu"),
        )
        self._remembered = self._algorithm.policy.initial_state(env.num_envs)

    def load(self, weights: dict[str, torch.Tensor], where: str) -> None:
        """Takes over weights."""
        policy: nn.Module = self._algorithm.policy
        try:
            policy.load_state_dict(weights)
        except RuntimeError as error:
            raise UserError(f"{where}: these weights do not fit the run's configuration") from error

    def reset(self) -> None:
        """Begins an episode everywhere."""
        self.env_runner.reset()
        self._remembered = self._algorithm.policy.initial_state(self.env_runner.env.num_envs)

    @torch.no_grad()
    def actions(self, *, deterministic: bool) -> NDArray[Any]:
        """Actions for the present observations."""
        env = self.env_runner.env
        space = env.single_observation_space
        observations = to_tensors(self.env_runner.observations, space, torch.device("cpu"))
        actions, self._remembered = self._algorithm.policy.act(
            replace(observations, sequences=Sequences.single(self._remembered)),
            deterministic=deterministic,
            generator=self._generator,
        )
        return to_environment(actions, env.single_action_space)

    def step(self, *, deterministic: bool) -> None:
        """Acts once everywhere; where an episode ends, it is forgotten."""
        step = self.env_runner.step(self.actions(deterministic=deterministic))
        self._remembered[torch.from_numpy(step.done)] = 0.0


def _whole_episodes(player: _Player, episodes: int, *, deterministic: bool) -> dict[str, Any]:
    """Plays until the first `episodes` to begin have ended.

    Those that end first would be the short ones, not like the others.
    """
    parts: list[EpisodeBatch] = []
    player.reset()
    while sum(map(len, parts)) < episodes:
        player.step(deterministic=deterministic)
        parts.append(player.env_runner.pop_finished())
    played = concatenate(parts)[:episodes]
    shares = _means(played.episode_metrics)
    rates = {"success": SUCCESS, "collision_rate": COLLISION}
    return {
        **{key: shares[name] for key, name in rates.items() if name in shares},
        "reward": float(played.rewards.mean()),
        "reward_std": float(played.rewards.std()),
        "episode_length": float(played.lengths.mean()),
    }


def _first_actions(
    player: _Player, episodes: int, check: PhysicalCheck | None, album: EvaluationReport | None
) -> dict[str, Any]:
    """Takes the deterministic policy's first action in every scene."""
    env = player.env_runner.env
    episode_metrics: list[dict[str, NDArray[Any]]] = []
    outcomes: list[dict[str, NDArray[Any]]] = []
    for begin in range(0, episodes, env.num_envs):
        player.reset()
        actions = player.actions(deterministic=True)
        # The last batch may have more environments than are asked for; and a step would reset them.
        asked_for = actions[: episodes - begin]
        outcomes.append(check(asked_for) if check is not None else {})
        if album is not None:
            album.add(asked_for, outcomes[-1])
        *_, infos = env.step(actions)
        episode_metrics.append(infos.get("episode_metrics", {}))
        if POSITION_ERROR not in episode_metrics[-1]:
            return {}  # it is not the first action that counts here
    return {**_errors(_joined(episode_metrics, episodes)), **_picks(_joined(outcomes, episodes))}


def _joined(parts: Sequence[dict[str, NDArray[Any]]], rows: int) -> dict[str, NDArray[Any]]:
    return {name: np.concatenate([part[name] for part in parts])[:rows] for name in parts[0]}


def _errors(episode_metrics: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    return {
        "first_action_success": float(episode_metrics[SUCCESS].mean()),
        "first_action_collision_rate": float(episode_metrics[COLLISION].mean()),
        "position_error_m": {
            **_median_and_p95(episode_metrics[POSITION_ERROR]),
            **{
                axis: float(np.median(episode_metrics[f"position_error_{axis}_m"]))
                for axis in "xyz"
            },
        },
        "yaw_error_deg": _median_and_p95(episode_metrics["yaw_error_deg"]),
    }


def _picks(outcomes: Mapping[str, NDArray[np.bool_]]) -> dict[str, Any]:
    if not outcomes:
        return {}
    rates = _means(outcomes)
    return {"pick_rate": rates.pop(SUCCESS), "pick_failures": rates}


def _means(columns: Mapping[str, NDArray[Any]]) -> dict[str, float]:
    return {name: float(values.mean()) for name, values in columns.items()}


def _median_and_p95(values: NDArray[np.float64]) -> dict[str, float]:
    return {"median": float(np.median(values)), "p95": float(np.percentile(values, 95))}
