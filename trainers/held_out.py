"""Evaluation while a run learns: in episodes that it never trains on, on the last lesson's task."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.environment import Environment
from envs.evaluation import EvaluationReport, Evaluator
from trainers.common.errors import UserError, suggestion
from trainers.common.timers import timed
from trainers.evaluation import evaluate_policy, evaluation_environment
from trainers.inference.policy import Policy
from trainers.networks.network import evaluation_mode
from trainers.reporting.event_log import RunLog
from trainers.reporting.figures import evaluation_tag, figure_values
from trainers.reporting.films import EpisodeCamera, Film
from trainers.runfile.settings import EvaluationSettings, RunSettings
from trainers.session import Session

FILM_TAG, DRAWN_TAG = "Evaluation/Episode", "Evaluation/First Actions"
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
        stop_requested: asked before every step of the evaluation's environments.

    Attributes:
        latest: the last report, with the `step` that it is of; empty before the first.
        took_s: seconds of that evaluation.
        begins_due: whether an evaluation is due at the very step at which the run is taken up.

    Raises:
        UserError: the interval is too short, the environment refuses the last lesson's parameters,
            or the target's metric is not among the figures.
        StopRequested: the first evaluation is to stop.
    """

    def __init__(
        self,
        session: Session,
        run: RunSettings,
        settings: EvaluationSettings,
        start_step: int,
        stop_requested: Callable[[], bool] = lambda: False,
    ):
        collection_steps = session.algorithm.collection_steps
        _check_interval(settings, collection_steps)
        self._settings, self._stop_requested = settings, stop_requested
        self._world = session.world
        self._evaluated_at = start_step - collection_steps
        self.begins_due = self.due(start_step)
        with self._world.together():
            # The first process evaluates for all of them.
            self._env = (
                evaluation_environment(run, settings.episodes) if self._world.writes else None
            )
        self._network = session.algorithm.policy
        self.latest: dict[str, Any] = {}
        self.took_s = 0.0
        self._drawn: DrawnActions | None = None
        self._film: Film | None = None
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
        """Evaluates the policy as it is now, and logs what is found.

        Raises:
            StopRequested: it is to stop; the latest report is that of before.
            EnvironmentFailure, NonFiniteError: its environments broke down.
        """
        self._evaluate(step)
        self.log(log)

    def log(self, log: RunLog) -> None:
        """Logs the latest report, and what can be drawn and filmed of it."""
        log.scalars(_tagged(self.latest), self.latest["step"])
        if self._drawn is not None and self._drawn.picture is not None:
            log.image(DRAWN_TAG, self._drawn.picture, self.latest["step"])
        if self._film is not None:
            log.video(FILM_TAG, self._film.frames, self._film.fps, self.latest["step"])

    @property
    def tags(self) -> tuple[str, ...]:
        """The tags of its curves."""
        return tuple(_tagged(self.latest))

    @property
    def scored_by(self) -> str:
        """Figure that policies are scored by."""
        return next(name for name in BEST_BY if name in self.latest)

    @property
    def score(self) -> float:
        """Score of the policy at the last evaluation; more is better."""
        return float(self.latest[self.scored_by])

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
        if self._env is not None:
            self._env.close()

    def _evaluate(self, step: int) -> None:
        start_s = time.monotonic()
        with self._world.together():
            report = {} if self._env is None else self._report(self._env)
        self.took_s = time.monotonic() - start_s
        self._evaluated_at, self.latest = step, {"step": step, **self._world.first(report)}

    def _report(self, env: Environment) -> dict[str, Any]:
        settings, network = self._settings, self._network
        # A new one each time: what it draws depends on the seed, not on the evaluations before.
        policy = Policy(
            network, env.single_observation_space, env.single_action_space, settings.seed
        )
        evaluator = env.evaluator()
        drawn = DrawnActions(evaluator)
        camera = EpisodeCamera(env, (0,)) if env.frames_per_second else None
        with timed("evaluation"), evaluation_mode(network):
            report = evaluate_policy(
                policy, env, settings.episodes, settings.seed,
                pictures=drawn if evaluator.judges_first_action else None,
                camera=camera, stop_requested=self._stop_requested,
            )  # fmt: skip
        self._drawn = drawn
        self._film = camera.films[0] if camera is not None else None
        return report

    def _check_target(self) -> None:
        target = self._settings.stop_when
        known = [name for name, part, _ in figure_values(self.latest) if not part]
        if target is not None and target.metric not in known:
            raise UserError(
                f"evaluation.stop_when.metric: {target.metric!r} is not among the figures of this "
                f"environment's evaluation; {suggestion(target.metric, known)}"
            )


class DrawnActions(EvaluationReport):
    """Has the first of an evaluation's first actions drawn.

    Attributes:
        picture: (H, W, 3); None where there is none.
    """

    file_names = ()

    def __init__(self, evaluator: Evaluator):
        self._evaluator = evaluator
        self.picture: NDArray[np.uint8] | None = None

    def add(self, actions: NDArray[Any], outcomes: Mapping[str, NDArray[np.bool_]]) -> None:
        """See `EvaluationReport`."""
        if self.picture is None:
            self.picture = self._evaluator.drawn(actions)

    def files(self) -> Iterator[tuple[str, bytes]]:
        """None; see `picture`."""
        yield from ()


def _check_interval(settings: EvaluationSettings, collection_steps: int) -> None:
    if settings.interval < collection_steps:
        raise UserError(
            f"evaluation.interval: {settings.interval} is under the {collection_steps} steps that "
            "are collected between two updates: raise it to that, at least"
        )


def _tagged(report: Mapping[str, Any]) -> dict[str, float]:
    """Figures by their TensorBoard tags."""
    return {evaluation_tag(name, part): value for name, part, value in figure_values(report)}
