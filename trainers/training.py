"""The training loop: collect, update, log, advance the lesson, evaluate, save."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envs.environment import EnvironmentFailure
from trainers.algorithms.base import TrainerSettings
from trainers.common.timers import timed
from trainers.experience.env_runner import StopRequested
from trainers.held_out import HeldOutEvaluation
from trainers.reporting.event_log import RunLog
from trainers.reporting.summary import Summary
from trainers.reporting.terminal import TerminalDisplay
from trainers.saving.checkpoint import Checkpoints
from trainers.session import Session


@dataclass(frozen=True)
class Ending:
    """End of a run.

    Attributes:
        finished: False if it was stopped, and can go on.
        reason: in words.
    """

    finished: bool
    reason: str


class Training:
    """One run's loop, and what it reports to.

    Args:
        session: what learns.
        settings: how long, and how often to save.
        log: TensorBoard and status.json.
        summary: gathers statistics for it.
        checkpoints: where the run is saved.
        display: the terminal.
        held_out: evaluates while it learns, if anything does.
    """

    def __init__(
        self,
        session: Session,
        settings: TrainerSettings,
        log: RunLog,
        summary: Summary,
        checkpoints: Checkpoints,
        display: TerminalDisplay,
        held_out: HeldOutEvaluation | None = None,
    ):
        self._session, self._settings, self._held_out = session, settings, held_out
        self._log, self._summary, self._display = log, summary, display
        self._checkpoints = checkpoints

    def run(self) -> Ending:
        """Trains until there is reason to end; what was learned is saved.

        Raises:
            EnvironmentFailure: an environment broke down; the run is saved as of the last update.
            NonFiniteError: a reward, an observation or a loss is not finite; nothing new is saved.
        """
        env_runner, max_steps = self._session.env_runner, self._settings.max_steps
        saved_at = env_runner.step_count
        while env_runner.step_count < max_steps:
            # Between an update and the next collection is where a run can be taken up again.
            step, boundary = env_runner.step_count, self._session.state_dict()
            try:
                self._learn(step / max_steps)
            except (StopRequested, EnvironmentFailure) as stop:
                self._save(step, boundary)
                if isinstance(stop, StopRequested):
                    return Ending(False, "stopped, and saved")
                raise
            step = env_runner.step_count
            evaluated = self._evaluate(step)
            if evaluated or step - saved_at >= self._settings.checkpoint_interval:
                saved_at = step
                self._save(step)
            if evaluated and (reached := evaluated.target_reached):
                return Ending(True, reached)
        if saved_at < env_runner.step_count:
            self._save(env_runner.step_count)
        return Ending(True, f"max_steps: {max_steps} steps were taken")

    def _learn(self, run_fraction: float) -> None:
        """Collects and updates once, and tells what came of it."""
        session, summary = self._session, self._summary
        with timed("collect"):
            session.algorithm.collect()
        with timed("update"):
            summary.add(session.algorithm.update(run_fraction))
        env_runner = session.env_runner
        episodes = env_runner.pop_finished()
        summary.add_episodes(episodes)
        if session.advance_curriculum(episodes, env_runner.step_count / self._settings.max_steps):
            begins = f"step {env_runner.step_count}: {session.lesson_title} begins"
            self._display.message(begins)
        with timed("summary"):
            summary.report(session.position, env_runner.observations, self._display)

    def _evaluate(self, step: int) -> HeldOutEvaluation | None:
        """Evaluates where it is time to: at each interval, and at the run's end."""
        held_out = self._held_out
        if held_out is None or not (held_out.due(step) or step >= self._settings.max_steps):
            return None
        held_out.evaluate(step, self._log)
        self._summary.note_evaluation(held_out.latest)
        return held_out

    def _save(self, step: int, state: dict[str, Any] | None = None) -> Path:
        with timed("checkpoint"):
            state = {"step": step, **(state or self._session.state_dict())}
            path = self._checkpoints.save(step, self._session.weights(), state, self._score(step))
        self._summary.note_checkpoint(path)
        return path

    def _score(self, step: int) -> float | None:
        """Score that the best checkpoint is chosen by.

        By an evaluation of this very policy where there are evaluations. By the reward in training
        otherwise; but those of different lessons can't be compared, and the newest counts.
        """
        if self._held_out is not None:
            latest = self._held_out.latest
            return self._held_out.score if latest["step"] == step else None
        return self._summary.reward if self._session.lesson_count == 1 else None
