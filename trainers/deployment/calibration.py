"""Calibration: a trained policy learns when it can be believed, from first actions of its own."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from envs.environment import Environment
from envs.evaluation import Use, right_answers
from trainers.common.errors import UserError, suggestion
from trainers.common.files import write_atomically
from trainers.evaluation import (
    SEEDS_PER_BATCH,
    RecordedPolicy,
    check_spaces,
    evaluation_environment,
    find_run,
    first_actions,
)
from trainers.experience.env_runner import EnvRunner
from trainers.inference.confidence import (
    FILE,
    Card,
    Confidence,
    Counts,
    Measured,
    judged_errors,
    to_bytes,
    weights_digest,
)
from trainers.inference.confidence_fit import (
    Examples,
    choose_threshold,
    fit,
    joined,
    ordinary_distance,
    rescale,
    without_mistakes,
)
from trainers.inference.onnx_policy import is_onnx
from trainers.inference.policy import Policy
from trainers.reporting.figures import Metrics
from trainers.runfile.settings import RunSettings
from trainers.saving.run_folder import find_checkpoint

_logger = logging.getLogger("ventosa")

TARGET = 0.995
"""Share of what is called sure that is to be right."""
FIRST_SEED = SEEDS_PER_BATCH
"""From here to `SEEDS_PER_BATCH` / 2 further on, neither runs nor evaluations have any seed."""
SEEDS_PER_PURPOSE = 2**24 * SEEDS_PER_BATCH
"""From the seeds of episodes for one purpose to those for the next."""
LEAST_EPISODES = 100
SHARES = (0.55, 0.30)
"""Of the episodes: to fit in, and to choose the threshold in; the rest is to measure in."""
AS_TRAINED = "as trained"
EPISODES_PER_UNANSWERABLE = 10
"""There is one observation of each kind that can't be answered for so many episodes."""
EPISODES_PER_HARDER = 20
"""There is one episode of each harder task for so many of the ordinary."""


def calibrate(
    name: str,
    *,
    episodes: int,
    seed: int = 0,
    overrides: Sequence[str] = (),
    results_dir: Path = Path("results"),
    trust: bool = False,
) -> tuple[Path, Card]:
    """Learns how sure a policy is, and stores that beside its weights.

    Args:
        name: a run (its best checkpoint), a checkpoint's or an exported folder.
        episodes: how many first actions to learn from, choose the threshold by, and measure with.
        seed: of the episodes, which neither a run nor an evaluation has; below `SEED_LIMIT`.
        overrides: `KEY=VALUE`s on top of the run's own configuration: the task that the promise is
            of, where that is not the one that the policy was trained for. It is fitted to the
            latter all the same.
        results_dir: where a run is looked for by its id.
        trust: see `trainers.evaluation.find_run`.

    Returns:
        The file that was written, and what is in it for people.

    Raises:
        UserError: there is no such policy, it can't be learned how sure it is, its environment
            does not say when an action is right, the task that the promise is of shows or takes
            something else, or the file can't be written.
        EnvironmentFailure: the environment broke down.
    """
    if is_onnx(name):
        raise UserError(f"{name}: calibrate the folder or the run, and export it anew")
    if episodes < LEAST_EPISODES:
        raise UserError(
            f"--episodes {episodes}: nothing can be learned from under {LEAST_EPISODES}"
        )
    folder = find_checkpoint(name, results_dir).path
    _, run = find_run(name, (), results_dir, trust=trust)
    _, promised_run = find_run(name, overrides, results_dir, trust=trust)
    policy = Policy.load(name, results_dir=results_dir, full_precision=True)
    if overrides:  # before the minutes that all else takes
        with closing(evaluation_environment(promised_run, 1)) as env:
            check_spaces(policy, env)
    fitted = int(SHARES[0] * episodes)
    with closing(evaluation_environment(run, fitted)) as env:
        features, metrics = _answered(policy, env, fitted, FIRST_SEED + seed)
        evaluator = env.evaluator()
        card = Card(
            weights_sha256=weights_digest(folder),
            features=features.shape[1],
            errors=judged_errors(evaluator.figures, evaluator.answer_limits),
            target=TARGET,
            episodes=episodes,
            seed=seed,
            overrides=tuple(overrides),
        )
        trained = _examples(card, features, metrics)
        unanswered = _unanswered(
            policy, env, episodes // EPISODES_PER_UNANSWERABLE, seed, len(card.estimated)
        )
    promised = _task(policy, promised_run, card, episodes - fitted, purpose=1)
    harder = {**dict(_harder(policy, run, card)), **unanswered["learn"]}
    confidence = learned(
        card, trained, promised, harder, unanswered["refuse"], unanswered["measure"]
    )
    try:
        write_atomically(folder / FILE, to_bytes(confidence))
    except OSError as error:
        raise UserError(f"{folder}: can't be written: {error.strerror}") from error
    return folder / FILE, confidence.card


Kinds = Mapping[str, Examples]
"""Examples by what is the matter with them."""


def learned(
    card: Card,
    trained: Examples,
    promised: Examples,
    harder: Kinds,
    refused: Kinds,
    unforeseen: Kinds,
) -> Confidence:
    """A confidence that was fitted, given its threshold, and measured, each in a part of its own.

    Args:
        card: what is known before.
        trained: of the task that the policy was trained for, to fit with.
        promised: of the task that the promise is of, to choose the threshold with and to measure.
        harder: of others, to fit with, too.
        refused: before what can't be answered, of which next to none is to be called sure.
        unforeseen: the same, left for the measuring.
    """
    confidence, choosing = Confidence(card), int(len(promised) * SHARES[1] / (1.0 - SHARES[0]))
    chosen, kept = promised[:choosing], promised[choosing:]
    others = [each[_parts(each)[0]] for each in (*harder.values(), *refused.values())]
    fit(confidence, trained, joined([chosen[:0], *others]), card.seed)
    rescale(confidence, chosen)
    with torch.no_grad():
        never = [
            without_mistakes(confidence(each[_parts(each)[1]].features).probability.numpy())
            for each in refused.values()
        ]
        far = ordinary_distance(confidence.distance(chosen.features))
        confidence.card = card.model_copy(update={"farthest": far})
        threshold = choose_threshold(
            confidence(chosen.features).probability.numpy(),
            chosen.right.numpy(),
            np.concatenate([[], *never]),
            card.target,
        )
    confidence.card = confidence.card.model_copy(update={"threshold": threshold})
    rest = {kind: each[_parts(each)[2]] for kind, each in refused.items()}
    measured = Measured(
        ordinary=_counts(confidence, kept),
        harder={what: _counts(confidence, each[_parts(each)[2]]) for what, each in harder.items()},
        unanswerable={
            k: _counts(confidence, each) for k, each in (rest | dict(unforeseen)).items()
        },
    )
    confidence.card = confidence.card.model_copy(update={"measured": measured})
    return confidence.eval()


def _parts(examples: Examples) -> tuple[slice, slice, slice]:
    """Rows to fit with, to choose the threshold with, and to measure with."""
    count = len(examples)
    first, second = int(SHARES[0] * count), int(sum(SHARES) * count)
    return slice(0, first), slice(first, second), slice(second, count)


@torch.no_grad()
def _counts(confidence: Confidence, examples: Examples) -> Counts:
    right, sure = examples.right, confidence(examples.features).sure
    return Counts(
        actions=len(examples),
        right=int(right.sum()),
        sure=int(sure.sum()),
        sure_right=int((right & sure).sum()),
    )


def _harder(policy: Policy, run: RunSettings, card: Card) -> Iterator[tuple[str, Examples]]:
    """Examples of other tasks that can be had, by what is harder in them."""
    count = card.episodes // EPISODES_PER_HARDER
    tasks = {AS_TRAINED: run.environment.settings} if card.overrides else {}
    for what, settings in {**tasks, **run.environment.cls.harder(run.environment.settings)}.items():
        other = replace(run, environment=replace(run.environment, settings=settings))
        try:
            yield what, _task(policy, other, card, count, purpose=2)
        except ValueError as error:
            _logger.warning("%s: left out, for it can't be had here: %s", what, error)


def _task(policy: Policy, run: RunSettings, card: Card, count: int, purpose: int) -> Examples:
    """So many examples of a task, with seeds of their own for each purpose."""
    seed = FIRST_SEED + card.seed + purpose * SEEDS_PER_PURPOSE
    with closing(evaluation_environment(run, count)) as env:
        return _examples(card, *_answered(policy, env, count, seed))


def _answered(policy: Policy, env: Environment, episodes: int, seed: int) -> tuple[Tensor, Metrics]:
    """Features (n, F) of first actions, and the episode metrics (n,) after them.

    Raises:
        UserError: the policy or the environment is of a kind that nothing can be learned from.
    """
    if policy.network.state_size:
        raise UserError(
            "the policy has memory, so that how sure it is depends on all that it has seen; only "
            "policies without can be calibrated"
        )
    if not (limits := env.evaluator().answer_limits):
        raise UserError(
            "the environment does not say when an action is right: declare `answer_limits` in its "
            "evaluator"
        )
    recorded = RecordedPolicy(policy)
    try:
        metrics, _ = first_actions(recorded, EnvRunner(env), episodes, seed)
    except NotImplementedError as error:
        raise UserError(
            f"the policy's network ({type(policy.network).__name__}) doesn't tell the features "
            "that its actions are chosen by: implement `features` and `act_on` in place of `act`"
        ) from error
    for name in limits:
        if name not in metrics:
            raise UserError(
                f"the environment limits {name!r}, which is not among its episode metrics; "
                f"{suggestion(name, metrics)}"
            )
    return torch.cat(recorded.features)[:episodes], metrics


def _unanswered(
    policy: Policy, env: Environment, count: int, seed: int, errors: int
) -> dict[str, Kinds]:
    """Examples of what can't be answered, so many of each kind, by their use."""
    found: dict[str, dict[str, list[Examples]]] = {use: {} for use in get_args(Use)}
    batch = min(count, env.num_envs)
    for first in range(0, count, batch):
        batch_seed = FIRST_SEED + seed + 3 * SEEDS_PER_PURPOSE + first * SEEDS_PER_BATCH
        for each in env.evaluator().unanswerable(batch, batch_seed):
            _, features = policy.first_actions(each.observations)
            examples = Examples.unanswerable(features, errors)
            found[each.use].setdefault(each.kind, []).append(examples)
    return {
        use: {kind: joined(parts)[:count] for kind, parts in kinds.items()}
        for use, kinds in found.items()
    }


def _examples(card: Card, features: Tensor, metrics: Metrics) -> Examples:
    limits = np.array([error.limit for error in card.errors])
    values = np.stack([metrics[error.metric].astype(float) for error in card.errors], axis=1)
    sized = limits > 0.0
    relative = values[:, sized] / limits[sized]
    return Examples(
        features,
        torch.from_numpy(relative).float(),
        torch.from_numpy(right_answers(metrics, {e.metric: e.limit for e in card.errors})),
    )
