"""Evaluation of a policy, in episodes it has never seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.environment import Environment, EnvironmentFailure
from envs.evaluation import EvaluationReport, Evaluator, Figure, PhysicalCheck
from trainers.common.errors import UserError
from trainers.common.stopping import may_be_given_up
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import EpisodeBatch, concatenate
from trainers.inference.metadata import read_metadata
from trainers.inference.onnx_policy import OnnxPolicy, is_onnx
from trainers.inference.policy import Policy
from trainers.reporting.figures import (
    Metrics,
    check_report,
    episode_figures,
    first_action_figures,
    report_figures,
    summaries,
    sureness_report,
)
from trainers.reporting.films import EpisodeCamera, EpisodeFilms
from trainers.reporting.progress import check_progress
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import RunSettings, load_run, load_run_document
from trainers.runfile.trust import check_imports
from trainers.runfile.yaml_document import parse
from trainers.saving.evaluation_folder import EVALUATION, EvaluationFolder
from trainers.saving.run_folder import CONFIGURATION, find_run_folder
from trainers.session import blaming_parameters, build_environment, final_parameters

# Run files take seeds below this, so that no run was ever trained on an evaluation's episodes.
FIRST_SEED = 2**32
"""Each of the seeds up to `SEED_LIMIT` has two of the numbers from here on."""
SEEDS_PER_BATCH = 2 * FIRST_SEED
"""From one batch of first actions to the next; runs and other evaluations have none of them."""
FIRST_ACTION, WHOLE_EPISODE = 0, 1
EPISODE_STEP_LIMIT = 100_000
"""Steps in which episodes of an evaluation have to end: more than a game of Atari's takes."""


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


class SavedPolicy(ActingPolicy, Protocol):
    """A policy that says what it is for.

    Attributes:
        observation_space: the observations that acting needs.
        action_space: of one environment.
    """

    observation_space: gymnasium.spaces.Dict
    action_space: gymnasium.Space[Any]


class RecordedPolicy:
    """A policy that keeps the features of all actions that it chooses.

    Args:
        policy: acts.

    Attributes:
        features: (B, F) of each call.
    """

    def __init__(self, policy: Policy):
        self._policy = policy
        self.features: list[Tensor] = []

    def predict(
        self,
        observations: Mapping[str, NDArray[Any]],
        state: NDArray[Any] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], None]:
        """See `Policy.first_actions`."""
        actions, features = self._policy.first_actions(observations)
        self.features.append(features)
        return actions, None


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
    trust: bool = False,
) -> Evaluation:
    """Evaluates a saved policy on the last lesson's task.

    Args:
        policy: a run's folder or id, a checkpoint's folder, or an ONNX file.
        episodes: see `evaluate_policy`; None: what the environment is judged by.
        seed: of the episodes, which no training run has seen; below `SEED_LIMIT`.
        overrides: `KEY=VALUE`s on top of the run's own configuration; the policy's networks stay
            as they were saved.
        results_dir: where a run is looked for by its id.
        check: try the first actions out in the environment's physical check.
        window: show that check as it goes.
        render: the folder for pictures; empty for `evaluation` in the run's own; None for none.
        trust: see `find_run`.

    Raises:
        UserError: there is no such policy, it does not fit its configuration, or what is asked for
            can't be had.
        EnvironmentFailure, NonFiniteError: the environment broke down.
    """
    folder, run = find_run(policy, overrides, results_dir, trust=trust)
    acting = _load(policy, results_dir, run.device, seed)
    count = episodes or run.environment.cls.evaluation_episodes
    with closing(evaluation_environment(run, count)) as env, ExitStack() as stack:
        check_spaces(acting, env)
        evaluator = env.evaluator()
        physical, shown = None, _Shown()
        if check:
            with _asked_for(f"the {evaluator.check_name}"):
                physical = evaluator.physical_check(window=window)
            stack.enter_context(closing(physical))
        if render is not None:
            shown = _Shown.of(env)
            into = EvaluationFolder(Path(render or folder / EVALUATION), shown.file_names)
        with check_progress(physical, evaluator.check_name, count):
            report = evaluate_policy(
                acting, env, count, seed,
                check=physical, pictures=shown.pictures, films=shown.films,
            )  # fmt: skip
        if render is not None:
            into.write(report, shown.files())
    return Evaluation(report, report_figures(evaluator))


@dataclass(frozen=True)
class _Shown:
    """What `--render` shows: first actions, whole episodes, or both."""

    pictures: EvaluationReport | None = None
    films: EpisodeFilms | None = None

    @classmethod
    def of(cls, env: Environment) -> _Shown:
        """All that an environment can show.

        Raises:
            UserError: that is nothing.
        """
        if not env.frames_per_second:
            with _asked_for("--render"):
                return cls(env.evaluator().pictures())
        films = EpisodeFilms(env)
        try:
            return cls(env.evaluator().pictures(), films)
        except ValueError:
            return cls(films=films)

    @property
    def file_names(self) -> tuple[str, ...]:
        return tuple(name for part in self._parts for name in part.file_names)

    def files(self) -> Iterator[tuple[str, bytes]]:
        for part in self._parts:
            yield from part.files()

    @property
    def _parts(self) -> list[EvaluationReport | EpisodeFilms]:
        return [part for part in (self.pictures, self.films) if part is not None]


def find_run(
    policy: str, overrides: Sequence[str], results_dir: Path, *, trust: bool = False
) -> tuple[Path, RunSettings]:
    """Folder and settings of the run a saved policy comes from; its weights are not used.

    Args:
        policy: see `evaluate`.
        overrides: the same.
        results_dir: the same.
        trust: import the modules that it names.

    Raises:
        UserError: there is no such policy, a plugin that it needs is not installed here, its
            configuration is not valid, or names modules that nobody said to import.
    """
    registries = load_registries()
    if is_onnx(policy):
        folder, origin = Path(policy).parent, f"{policy}: {CONFIGURATION}"
        document = parse(OnnxPolicy.load(policy).configuration, origin, lines=True)
        run = load_run_document(document, overrides, registries)
    else:
        folder = find_run_folder(policy, results_dir)
        if metadata := read_metadata(folder):
            metadata.check_plugins(registries, folder)
        origin = str(folder / CONFIGURATION)
        run = load_run(folder / CONFIGURATION, overrides, registries)
    check_imports(run, origin, trust=trust)
    return folder, run


def _load(policy: str, results_dir: Path, device: str, seed: int) -> SavedPolicy:
    if is_onnx(policy):
        return OnnxPolicy.load(policy, seed)
    return Policy.load(policy, results_dir=results_dir, device=device, seed=seed)


def check_spaces(policy: SavedPolicy, env: Environment) -> None:
    """Refuses an environment that shows or takes something else than the policy was trained on.

    Raises:
        UserError: with the first that differs.
    """
    shown = env.single_observation_space.spaces
    pairs = [
        (f"observation {name!r}", space, shown.get(name))
        for name, space in policy.observation_space.spaces.items()
    ]
    for what, own, found in (*pairs, ("actions", policy.action_space, env.single_action_space)):
        if own != found:
            raise UserError(
                f"the environment's {what}: {found}, where the policy was trained on {own}; leave "
                "out the KEY=VALUE or the option that changes it"
            )


@contextmanager
def _asked_for(what: str) -> Iterator[None]:
    """Turns a ValueError about something that was asked for into the user's mistake."""
    try:
        yield
    except ValueError as error:
        raise UserError(f"{what}: {error}") from error


def evaluation_environment(run: RunSettings, episodes: int) -> Environment:
    """Environments for evaluation alone: the run's, on its last lesson's task.

    Args:
        run: the settings.
        episodes: how many it will be evaluated by; there are no more environments than those.

    Raises:
        UserError: the environment refuses its settings or the last lesson's parameters.
    """
    env = build_environment(run.with_environments(episodes), FIRST_SEED)
    try:
        with blaming_parameters():
            env.set_parameters(final_parameters(run))
    except BaseException:
        env.close()
        raise
    return env


def evaluate_policy(
    policy: ActingPolicy,
    env: Environment,
    episodes: int,
    seed: int = 0,
    *,
    check: PhysicalCheck | None = None,
    pictures: EvaluationReport | None = None,
    films: EpisodeFilms | None = None,
    camera: EpisodeCamera | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Evaluates a policy in environments that serve nothing else: they are reset.

    Where the environment's evaluator judges the first action, the deterministic policy's is judged
    by itself, and the whole episodes are played as at the end of training: with actions that are
    drawn, or bear what exploration noise was left. Elsewhere the deterministic policy plays them.

    Args:
        policy: acts.
        env: its own parameters are set already.
        episodes: how many, for the first actions and for the whole episodes each.
        seed: of the episodes: equal seeds, equal beginnings, for as many environments. Among whole
            episodes that is so for the first of each environment; how those that follow begin may
            depend on when the ones before them ended.
        check: what the first actions are tried out in.
        pictures: are shown the first actions.
        films: of whole episodes; the worst are played again for that.
        camera: films whole episodes, too, where there is no need for the worst.
        stop_requested: asked before every step of the whole episodes.

    Returns:
        `episodes`, `seed`; of the whole episodes `success`, where it is known, the environment's
        figures, the means `reward` and `episode_length`, and `reward_std`. Where the first action
        is judged its rates have `first_action_` before their names, and errors are those of the
        first action alone. Of a policy that knows how sure it is: `sure`, the share of the first
        actions, and `sure_right`, the share of those that are right, where there are any. With a
        physical check NAME: `NAME_rate`, and the shares of `NAME_failures`.

    Raises:
        UserError: the environment does not report what its figures are made of.
        StopRequested: the evaluation is to stop.
        EnvironmentFailure, NonFiniteError: the environment broke down.
    """
    evaluator, env_runner = env.evaluator(), EnvRunner(env, stop_requested)
    first_seed = FIRST_SEED + 2 * seed
    first: dict[str, Any] = {}
    if evaluator.judges_first_action or check is not None or pictures is not None:
        first = _first_action_report(
            policy, env_runner, episodes, first_seed + FIRST_ACTION, check, pictures
        )
    play = partial(
        _whole_episodes,
        policy,
        env_runner,
        seed=first_seed + WHOLE_EPISODE,
        deterministic=not evaluator.judges_first_action,
    )
    played = play(episodes, camera=films.first if films is not None else camera)
    whole = _episode_report(evaluator, played)
    if films is not None:
        play(films.aim_at_worst(played), camera=films.worst)
    return {"episodes": episodes, "seed": seed, **whole, **first}


def _first_action_report(
    policy: ActingPolicy,
    env_runner: EnvRunner,
    episodes: int,
    seed: int,
    check: PhysicalCheck | None,
    pictures: EvaluationReport | None,
) -> dict[str, Any]:
    """Figures of first actions, how sure the policy is of them, and the physical check's."""
    evaluator = env_runner.env.evaluator()
    recorded = RecordedPolicy(policy) if isinstance(policy, Policy) else None
    confidence = policy.confidence if isinstance(policy, Policy) else None
    acting = policy if recorded is None or confidence is None else recorded
    metrics, outcomes = first_actions(acting, env_runner, episodes, seed, check, pictures)
    report: dict[str, Any] = {}
    if evaluator.judges_first_action:
        report |= summaries(first_action_figures(evaluator), metrics)
    if recorded is not None and confidence is not None:
        with torch.no_grad():
            sure = confidence(torch.cat(recorded.features)[:episodes]).sure.cpu().numpy()
        report |= sureness_report(sure, evaluator.answer_limits, metrics)
    return report | check_report(evaluator.check_name, outcomes)


def _episode_report(evaluator: Evaluator, played: EpisodeBatch) -> dict[str, Any]:
    """Figures and rewards of whole episodes."""
    return {
        **summaries(episode_figures(evaluator), played.episode_metrics),
        "reward": float(played.rewards.mean()),
        "reward_std": float(played.rewards.std()),
        "episode_length": float(played.lengths.mean()),
    }


def first_actions(
    policy: ActingPolicy,
    env_runner: EnvRunner,
    episodes: int,
    seed: int,
    check: PhysicalCheck | None = None,
    pictures: EvaluationReport | None = None,
) -> tuple[Metrics, Metrics]:
    """Takes the deterministic policy's first action in every episode.

    Args:
        policy: acts.
        env_runner: of the environments.
        episodes: how many.
        seed: of the first batch; that of the next is higher by `SEEDS_PER_BATCH`.
        check: what actions are tried out in.
        pictures: are shown them.

    Returns:
        By name (episodes,): the metrics after it, and what the physical check says of it.
    """
    env = env_runner.env
    metrics: list[Metrics] = []
    outcomes: list[Metrics] = []
    for batch, begin in enumerate(range(0, episodes, env.num_envs)):
        # Seeded anew, for how often the step before drew depends on what it came to.
        env_runner.reset(seed + batch * SEEDS_PER_BATCH)
        actions, _ = policy.predict(env_runner.observations)
        # The last batch may have more environments than are asked for; and a step would reset them.
        asked_for = actions[: episodes - begin]
        outcomes.append(check(asked_for) if check is not None else {})
        if pictures is not None:
            pictures.add(asked_for, outcomes[-1])
        with may_be_given_up():
            *_, infos = env.step(actions)
        metrics.append(infos.get("episode_metrics", {}))
    return _joined(metrics, episodes), _joined(outcomes, episodes)


def _joined(parts: Sequence[Metrics], rows: int) -> Metrics:
    return {name: np.concatenate([part[name] for part in parts])[:rows] for name in parts[0]}


def _whole_episodes(
    policy: ActingPolicy,
    env_runner: EnvRunner,
    episodes: int,
    *,
    seed: int,
    deterministic: bool,
    camera: EpisodeCamera | None = None,
) -> EpisodeBatch:
    """Plays until the first `episodes` to begin have ended.

    Those that end first would be the short ones, not like the others.

    Raises:
        EnvironmentFailure: one has not ended within `EPISODE_STEP_LIMIT` steps.
    """
    parts: list[EpisodeBatch] = []
    finished = 0
    env_runner.reset(seed)
    first = int(env_runner.running.min())
    state: NDArray[Any] | None = None
    while finished < episodes:
        actions, state = policy.predict(env_runner.observations, state, deterministic)
        if camera is not None:
            camera.before_step(env_runner.running - first)
        step = env_runner.step(actions)
        if camera is not None:
            camera.after_step(actions, step.reward)
        if env_runner.longest_episode >= EPISODE_STEP_LIMIT:
            raise EnvironmentFailure(
                f"an episode of the evaluation has not ended in {EPISODE_STEP_LIMIT} steps: set a "
                "limit, such as environment.max_episode_steps=1000 where it is gymnasium's"
            )
        if state is not None:
            state[step.done] = 0.0
        parts.append(env_runner.pop_finished())
        finished += len(parts[-1])
    return concatenate(parts)[:episodes]
