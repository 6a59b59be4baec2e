"""Evaluation while a run learns: in episodes that it never trains on, on the last lesson's task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from trainers.common.errors import UserError, suggestion
from trainers.common.timers import timed
from trainers.evaluation import evaluate_policy, evaluation_environment
from trainers.inference.policy import Policy
from trainers.reporting.event_log import RunLog
from trainers.runfile.settings import EvaluationSettings, RunSettings
from trainers.session import Session

BEST_BY = ("first_action_success", "success", "reward")
"""Entries of a report that say how good a policy is, the one to be preferred first."""


class HeldOutEvaluation:
    """Evaluates the policy every so many steps, in environments of its own.

    The deterministic policy is meant wherever the environment's evaluator does not say otherwise;
    see `trainers.evaluation.evaluate_policy`. Training is not touched by it.

    Args:
        session: whose policy it is.
        run: the settings, with their section `evaluation`.
        settings: that section.
        start_step: steps the run had when this process took it up.

    Attributes:
        latest: the last report, with the `step` that it is of; empty before the first.

    Raises:
        UserError: the interval is too short, or the target's metric is not among the figures.
    """

    def __init__(
        self, session: Session, run: RunSettings, settings: EvaluationSettings, start_step: int
    ):
        _check_interval(settings, session.algorithm.collection_steps)
        self._settings, self._evaluated_at = settings, start_step
        self._env = evaluation_environment(run, settings.episodes)
        network = session.algorithm.policy
        self._policy = Policy(
            network, self._env.single_observation_space, self._env.single_action_space
        )
        self.latest: dict[str, Any] = {}
        try:
            self._evaluate(start_step)
            self._check_target()
        except BaseException:
            self.close()
            raise

    def due(self, step: int) -> bool:
        """Whether an interval is over."""
        interval = self._settings.interval
        return step // interval > self._evaluated_at // interval

    def evaluate(self, step: int, log: RunLog) -> None:
        """Evaluates the policy as it is now, and logs what is found."""
        self._evaluate(step)
        self.log(log)

    def log(self, log: RunLog) -> None:
        """Logs the latest report."""
        log.scalars(dict(_tagged(self.latest)), self.latest["step"])

    @property
    def score(self) -> float:
        """Score of the policy at the last evaluation; more is better."""
        return next(float(self.latest[name]) for name in BEST_BY if name in self.latest)

    @property
    def target_reached(self) -> str | None:
        """In words, that the target was reached; None where it was not, or there is none."""
        target = self._settings.stop_when
        if target is None or self.latest[target.metric] < target.at_least:
            return None
        value = self.latest[target.metric]
        return f"evaluation.stop_when: {target.metric} is {value:g}, at least {target.at_least:g}"

    def close(self) -> None:
        """Ends its environments."""
        self._env.close()

    def _evaluate(self, step: int) -> None:
        with timed("evaluation"):
            settings = self._settings
            report = evaluate_policy(self._policy, self._env, settings.episodes, settings.seed)
        self._evaluated_at, self.latest = step, {"step": step, **report}

    def _check_target(self) -> None:
        target = self._settings.stop_when
        known = [name for name, _ in _numbers(self.latest)]
        if target is not None and target.metric not in known:
            raise UserError(
                f"evaluation.stop_when.metric: {target.metric!r} is not among the figures of this "
                f"environment's evaluation; {suggestion(target.metric, known)}"
            )


def _check_interval(settings: EvaluationSettings, collection_steps: int) -> None:
    if settings.interval < collection_steps:
        raise UserError(
            f"evaluation.interval: {settings.interval} is under the {collection_steps} steps that "
            "are collected between two updates: raise it to that, at least"
        )


def _numbers(report: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for name, value in report.items():
        if isinstance(value, (int, float)) and name not in ("step", "episodes", "seed"):
            yield name, float(value)


def _tagged(report: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """TensorBoard's tags and what they show."""
    for name, value in report.items():
        title = name.replace("_", " ").title()
        if isinstance(value, Mapping):
            for part, number in value.items():
                yield f"Evaluation/{title} {part.title()}", float(number)
    for name, number in _numbers(report):
        yield f"Evaluation/{name.replace('_', ' ').title()}", number
