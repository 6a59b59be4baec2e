"""Evaluation of a policy, in episodes it has never seen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from curricula.samplers import ParameterValue
from envs.environment import Environment
from envs.evaluation import EvaluationReport, Figure, PhysicalCheck
from trainers.common.errors import UserError
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import EpisodeBatch, concatenate
from trainers.inference.policy import Policy, load_weights
from trainers.networks.policy_network import PolicyNetwork
from trainers.reporting.figures import (
    Metrics,
    check_report,
    episode_figures,
    first_action_figures,
    report_figures,
    summaries,
)
from trainers.runfile.registry import Registries, load_registries
from trainers.runfile.settings import RunSettings, load_run
from trainers.saving.checkpoint import Loaded
from trainers.saving.evaluation_folder import EVALUATION, EvaluationFolder
from trainers.saving.run_folder import CONFIGURATION, find_checkpoint, run_folder
from trainers.session import (
    build_curriculum,
    build_environment,
    build_factory,
    set_parameters,
)

# Run files take seeds below this, so that no run was ever trained on an evaluation's episodes.
FIRST_SEED = 2**32
FIRST_ACTION, WHOLE_EPISODE = 0, 1


class ActingPolicy(Protocol):
    """A policy that can be evaluated."""

    def predict(
        self,
        observations: Mapping[str, NDArray[Any]],
        state: NDArray[Any] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """Actions (N, ...) for observations (N, ...), and the hidden state (N, m) after them.

        Args:
            observations: by name, as the environment gives them.
            state: the hidden state before them, zeros where an episode begins; None: they all do.
            deterministic: the policy's best actions, or drawn as at the end of training.
        """


@dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation.

    Attributes:
        report: plain data, see `evaluate_policy`.
        figures: how people read its entries, by their keys.
    """

    report: dict[str, Any]
    figures: dict[str, Figure]


def evaluate(
    policy: str,
    *,
    episodes: int | None = None,
    seed: int = 0,
    overrides: Sequence[str] = (),
    results_dir: Path = Path("results"),
    check: bool = False,
    window: bool = False,
    render: str | None = None,
) -> Evaluation:
    """Evaluates a saved policy on the last lesson's task.

    Args:
        policy: a run's folder or id, or a checkpoint's folder.
        episodes: see `evaluate_policy`; None: what the environment is judged by.
        seed: of the episodes, which no training run has seen.
        overrides: `KEY=VALUE`s on top of the run's own configuration.
        results_dir: where a run is looked for by its id.
        check: try the first actions out in the environment's physical check.
        window: show that check as it goes.
        render: the folder for pictures; empty for `evaluation` in the run's own; None for none.

    Raises:
        UserError: there is no such policy, it does not fit its configuration, or what is asked for
            can't be had.
    """
    run, loaded, registries = find_run(policy, overrides, results_dir)
    with closing(build_environment(run, FIRST_SEED + 2 * seed)) as env, ExitStack() as stack:
        set_parameters(env, final_parameters(run))
        player = _policy(run, registries, env, loaded, seed)
        evaluator = env.evaluator()
        physical, pictures, gallery = None, None, None
        if check:
            with _asked_for(f"the {evaluator.check_name}"):
                physical = evaluator.physical_check(window=window)
            stack.enter_context(closing(physical))
        if render is not None:
            with _asked_for("--render"):
                pictures = evaluator.pictures()
            where = Path(render) if render else run_folder(loaded.path) / EVALUATION
            gallery = EvaluationFolder(where, pictures.file_names)
        count = episodes or env.evaluation_episodes
        report = evaluate_policy(player, env, count, seed, check=physical, pictures=pictures)
        if pictures is not None and gallery is not None:
            gallery.write(report, pictures.files())
    return Evaluation(report, report_figures(evaluator))


def find_run(
    policy: str, overrides: Sequence[str], results_dir: Path
) -> tuple[RunSettings, Loaded, Registries]:
    """The run a saved policy comes from, its weights, and the components that it may name.

    Raises:
        UserError: there is no such policy, or its configuration is not valid.
    """
    registries = load_registries()
    loaded = find_checkpoint(policy, results_dir)
    run = load_run(run_folder(loaded.path) / CONFIGURATION, overrides, registries)
    return run, loaded, registries


@contextmanager
def _asked_for(what: str) -> Iterator[None]:
    """Turns a ValueError about something that was asked for into the user's mistake."""
    try:
        yield
    except ValueError as error:
        raise UserError(f"{what}: {error}") from error


def final_parameters(run: RunSettings) -> dict[str, ParameterValue]:
    """Environment parameters of the run's last lesson."""
    curriculum = build_curriculum(run)
    lesson = {} if curriculum is None else curriculum.final_parameters()
    return {**run.environment_parameters, **lesson}


def evaluation_environment(run: RunSettings, episodes: int) -> Environment:
    """Environments for evaluation alone: the run's, on its last lesson's task.

    Args:
        run: the settings.
        episodes: how many it will be evaluated by; there are no more environments than those.
    """
    settings = run.environment.settings
    if getattr(settings, "num_envs", 1) > episodes:
        few = replace(run.environment, settings=settings.model_copy(update={"num_envs": episodes}))
        run = replace(run, environment=few)
    env = build_environment(run, FIRST_SEED)
    set_parameters(env, final_parameters(run))
    return env


def evaluate_policy(
    policy: ActingPolicy,
    env: Environment,
    episodes: int,
    seed: int = 0,
    *,
    check: PhysicalCheck | None = None,
    pictures: EvaluationReport | None = None,
) -> dict[str, Any]:
    """Evaluates a policy in environments that serve nothing else: they are reset.

    Where the environment's evaluator judges the first action, the deterministic policy's is judged
    by itself, and the whole episodes are played as at the end of training: with actions that are
    drawn, or bear what exploration noise was left. Elsewhere the deterministic policy plays them.

    Args:
        policy: acts.
        env: its own parameters are set already.
        episodes: how many, for the first actions and for the whole episodes each.
        seed: of the episodes: equal seeds, equal beginnings.
        check: what the first actions are tried out in.
        pictures: are shown the first actions.

    Returns:
        `episodes`, `seed`; of the whole episodes `success`, where it is known, the environment's
        figures, the means `reward` and `episode_length`, and `reward_std`. Where the first action
        is judged its rates have `first_action_` before their names, and errors are those of the
        first action alone. With a physical check NAME: `NAME_rate`, and the shares of
        `NAME_failures`.

    Raises:
        UserError: the environment does not report what its figures are made of.
    """
    evaluator, env_runner = env.evaluator(), EnvRunner(env)
    first_seed = FIRST_SEED + 2 * seed
    first: dict[str, Any] = {}
    if evaluator.judges_first_action or check is not None or pictures is not None:
        metrics, outcomes = _first_actions(
            policy, env_runner, episodes, first_seed + FIRST_ACTION, check, pictures
        )
        if evaluator.judges_first_action:
            first |= summaries(first_action_figures(evaluator), metrics)
        first |= check_report(evaluator.check_name, outcomes)
    played = _whole_episodes(
        policy,
        env_runner,
        episodes,
        first_seed + WHOLE_EPISODE,
        deterministic=not evaluator.judges_first_action,
    )
    return {
        "episodes": episodes,
        "seed": seed,
        **summaries(episode_figures(evaluator), played.episode_metrics),
        "reward": float(played.rewards.mean()),
        "reward_std": float(played.rewards.std()),
        "episode_length": float(played.lengths.mean()),
        **first,
    }


def _first_actions(
    policy: ActingPolicy,
    env_runner: EnvRunner,
    episodes: int,
    seed: int,
    check: PhysicalCheck | None,
    pictures: EvaluationReport | None,
) -> tuple[Metrics, Metrics]:
    """Takes the deterministic policy's first action in every episode.

    Returns:
        By name (episodes,): the metrics after it, and what the physical check says of it.
    """
    env = env_runner.env
    metrics: list[Metrics] = []
    outcomes: list[Metrics] = []
    for begin in range(0, episodes, env.num_envs):
        env_runner.reset(seed if begin == 0 else None)
        actions, _ = policy.predict(env_runner.observations)
        # The last batch may have more environments than are asked for; and a step would reset them.
        asked_for = actions[: episodes - begin]
        outcomes.append(check(asked_for) if check is not None else {})
        if pictures is not None:
            pictures.add(asked_for, outcomes[-1])
        *_, infos = env.step(actions)
        metrics.append(infos.get("episode_metrics", {}))
    return _joined(metrics, episodes), _joined(outcomes, episodes)


def _joined(parts: Sequence[Metrics], rows: int) -> Metrics:
    return {name: np.concatenate([part[name] for part in parts])[:rows] for name in parts[0]}


def _whole_episodes(
    policy: ActingPolicy, env_runner: EnvRunner, episodes: int, seed: int, *, deterministic: bool
) -> EpisodeBatch:
    """Plays until the first `episodes` to begin have ended.

    Those that end first would be the short ones, not like the others.
    """
    parts: list[EpisodeBatch] = []
    env_runner.reset(seed)
    state: NDArray[Any] | None = None
    while sum(map(len, parts)) < episodes:
        actions, state = policy.predict(env_runner.observations, state, deterministic)
        done = env_runner.step(actions).done
        if state is not None:
            state[done] = 0.0
        parts.append(env_runner.pop_finished())
    return concatenate(parts)[:episodes]


def _policy(
    run: RunSettings, registries: Registries, env: Environment, loaded: Loaded, seed: int
) -> Policy:
    """The run's policy before an environment."""
    network: PolicyNetwork = run.trainer.cls.build_policy(
        build_factory(run, registries, env), run.trainer.settings
    )
    load_weights(network, loaded.weights, str(loaded.path))
    return Policy(network, env.single_observation_space, env.single_action_space, seed)
