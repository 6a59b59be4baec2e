"""Calibration: a trained policy learns when it can be believed, from first actions of its own."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.environment import Environment
from trainers.common.errors import UserError, suggestion
from trainers.common.files import write_atomically
from trainers.evaluation import (
    SEEDS_PER_BATCH,
    evaluation_environment,
    find_run,
    first_actions,
)
from trainers.experience.env_runner import EnvRunner
from trainers.inference.confidence import (
    FILE,
    Card,
    Confidence,
    Measured,
    judged_errors,
    to_bytes,
    weights_digest,
)
from trainers.inference.confidence_fit import (
    Examples,
    choose_threshold,
    fit,
    ordinary_distance,
    rescale,
)
from trainers.inference.onnx_policy import is_onnx
from trainers.inference.policy import Policy
from trainers.reporting.figures import Metrics
from trainers.saving.run_folder import find_checkpoint

TARGET = 0.995
"""Share of what is called sure that is to be right."""
MISTAKES_ALLOWED = 0.8
"""Share of the mistakes that the target allows with which the threshold is chosen already."""
FIRST_SEED = SEEDS_PER_BATCH
"""From here to `SEEDS_PER_BATCH` / 2 further on, neither runs nor evaluations have any seed."""
LEAST_EPISODES = 100
SHARES = (0.55, 0.30)
"""Of the episodes: to fit in, and to choose the threshold in; the rest is to measure in."""
EPISODES_PER_UNANSWERABLE = 40
"""There is one observation of each kind that can't be answered for so many episodes."""


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


def calibrate(
    name: str, *, episodes: int, seed: int = 0, results_dir: Path = Path("results")
) -> tuple[Path, Card]:
    """Learns how sure a policy is, and stores that beside its weights.

    Args:
        name: a run (its best checkpoint), a checkpoint's or an exported folder.
        episodes: how many first actions to learn from, choose the threshold by, and measure with.
        seed: of the episodes, which neither a run nor an evaluation has; below `SEED_LIMIT`.
        results_dir: where a run is looked for by its id.

    Returns:
        The file that was written, and what is in it for people.

    Raises:
        UserError: there is no such policy, it can't be learned how sure it is, its environment
            does not say when an action is right, or the file can't be written.
        EnvironmentFailure: the environment broke down.
    """
    if is_onnx(name):
        raise UserError(f"{name}: calibrate the folder or the run, and export it anew")
    if episodes < LEAST_EPISODES:
        raise UserError(
            f"--episodes {episodes}: nothing can be learned from under {LEAST_EPISODES}"
        )
    folder = find_checkpoint(name, results_dir).path
    policy = Policy.load(name, results_dir=results_dir, full_precision=True)
    _, run = find_run(name, (), results_dir)
    with closing(evaluation_environment(run, episodes)) as env:
        features, metrics = _answered(policy, env, episodes, FIRST_SEED + seed)
        unanswerable = _unanswered(policy, env, episodes // EPISODES_PER_UNANSWERABLE, seed)
        limits = dict(env.evaluator().answer_limits)
        card = Card(
            weights_sha256=weights_digest(folder),
            features=features.shape[1],
            errors=judged_errors(env.evaluator().figures, limits),
            target=TARGET,
            episodes=episodes,
            seed=seed,
        )
    confidence = learned(card, _examples(card, features, metrics), *unanswerable)
    try:
        write_atomically(folder / FILE, to_bytes(confidence))
    except OSError as error:
        raise UserError(f"{folder}: can't be written: {error.strerror}") from error
    return folder / FILE, confidence.card


def learned(
    card: Card,
    examples: Examples,
    foreseen: Mapping[str, Tensor],
    unforeseen: Mapping[str, Tensor],
) -> Confidence:
    """A confidence that was fitted, given its threshold, and measured, each in a part of its own.

    Args:
        card: what is known before.
        examples: of first actions.
        foreseen: by kind, features (m, F) of what can't be answered.
        unforeseen: the same of kinds that are left for the measuring.
    """
    fitted, chosen, measured = _parts(len(examples))
    confidence = Confidence(card)
    none = _unanswerable_examples(card, [each[_parts(len(each))[0]] for each in foreseen.values()])
    fit(confidence, examples[fitted], none, card.seed)
    rescale(confidence, examples[chosen])
    with torch.no_grad():
        far = ordinary_distance(confidence.distance(examples.features[chosen]))
        confidence.card = card.model_copy(update={"farthest": far})
        refused = [each[_parts(len(each))[1]] for each in foreseen.values()]
        threshold = choose_threshold(
            confidence(examples.features[chosen]).probability.numpy(),
            examples.right[chosen].numpy(),
            confidence(torch.cat([*refused, examples.features[:0]])).probability.numpy(),
            1.0 - MISTAKES_ALLOWED * (1.0 - card.target),
        )
        confidence.card = confidence.card.model_copy(update={"threshold": threshold})
        kinds = {kind: each[_parts(len(each))[2]] for kind, each in foreseen.items()}
        report = _measured(confidence, examples[measured], {**kinds, **unforeseen})
        confidence.card = confidence.card.model_copy(update={"measured": report})
    return confidence.eval()


def _parts(count: int) -> tuple[slice, slice, slice]:
    """Rows to fit with, to choose the threshold with, and to measure with."""
    first, second = int(SHARES[0] * count), int(sum(SHARES) * count)
    return slice(0, first), slice(first, second), slice(second, count)


def _measured(
    confidence: Confidence, examples: Examples, unanswerable: Mapping[str, Tensor]
) -> Measured:
    sure = confidence(examples.features).sure
    return Measured(
        episodes=len(examples),
        right=float(examples.right.float().mean()),
        coverage=float(sure.float().mean()),
        sure_right=float(examples.right[sure].float().mean()) if sure.any() else None,
        unanswerable={
            kind: (len(each), int(confidence(each).sure.sum()))
            for kind, each in unanswerable.items()
        },
    )


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
    policy: Policy, env: Environment, count: int, seed: int
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Features (count, F) of what can't be answered, by kind: foreseen, and not."""
    foreseen: dict[str, list[Tensor]] = {}
    unforeseen: dict[str, list[Tensor]] = {}
    batch = min(count, env.num_envs)
    for number in range(-(-count // batch)):
        # No evaluation and no run seeds anything by more than one number.
        for each in env.evaluator().unanswerable(
            batch, FIRST_SEED + seed + number * SEEDS_PER_BATCH
        ):
            kinds = foreseen if each.is_foreseen else unforeseen
            _, features = policy.first_actions(each.observations)
            kinds.setdefault(each.kind, []).append(features)
    return (
        {kind: torch.cat(parts)[:count] for kind, parts in foreseen.items()},
        {kind: torch.cat(parts)[:count] for kind, parts in unforeseen.items()},
    )


def _examples(card: Card, features: Tensor, metrics: Metrics) -> Examples:
    limits = np.array([error.limit for error in card.errors])
    values = np.stack([metrics[error.metric].astype(float) for error in card.errors], axis=1)
    sized = limits > 0.0
    relative = values[:, sized] / limits[sized]
    return Examples(
        features,
        torch.from_numpy(relative).float(),
        torch.from_numpy((values <= limits).all(axis=1)),
    )


def _unanswerable_examples(card: Card, features: list[Tensor]) -> Examples:
    joined = torch.cat([*features, torch.empty(0, card.features)])
    errors = torch.full((len(joined), len(card.estimated)), torch.inf)
    return Examples(joined, errors, torch.zeros(len(joined), dtype=torch.bool))
