"""The training loop: collect, update, log, advance the lesson, save."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from envs.environment import EnvironmentFailure
from trainers.algorithms.base import TrainerSettings
from trainers.common.timers import timed
from trainers.experience.env_runner import StopRequested
from trainers.reporting.summary import Summary
from trainers.reporting.terminal import TerminalDisplay
from trainers.saving.checkpoint import Checkpoints
from trainers.session import Session


def train(
    session: Session,
    settings: TrainerSettings,
    summary: Summary,
    checkpoints: Checkpoints,
    display: TerminalDisplay,
) -> bool:
    """Trains until the steps are used up or a stop is requested; what was learned is saved.

    Returns:
        Whether the run is finished; False if it was stopped.

    Raises:
        EnvironmentFailure: an environment broke down; the run is saved as of the last update.
        NonFiniteError: a reward, an observation or a loss is not finite; nothing new is saved.
    """
    env_runner, algorithm = session.env_runner, session.algorithm
    max_steps = settings.max_steps
    saved_at = env_runner.step_count
    while env_runner.step_count < max_steps:
        # Between an update and the next collection is where a run can be taken up again.
        step, boundary = env_runner.step_count, session.state_dict()
        try:
            with timed("collect"):
                algorithm.collect()
        except (StopRequested, EnvironmentFailure) as stop:
            _save(session, checkpoints, step, boundary, summary.score)
            if isinstance(stop, StopRequested):
                return False
            raise
        with timed("update"):
            summary.add(algorithm.update(step / max_steps))
        episodes = env_runner.pop_finished()
        summary.add_episodes(episodes)
        if session.advance_curriculum(episodes, env_runner.step_count / max_steps):
            display.message(f"step {env_runner.step_count}: {session.lesson_title} begins")
        with timed("summary"):
            summary.report(session.position, env_runner.observations, display)
        if env_runner.step_count - saved_at >= settings.checkpoint_interval:
            saved_at = env_runner.step_count
            path = _save(session, checkpoints, saved_at, session.state_dict(), summary.score)
            summary.note_checkpoint(path)
    _save(session, checkpoints, env_runner.step_count, session.state_dict(), summary.score)
    return True


def _save(
    session: Session,
    checkpoints: Checkpoints,
    step: int,
    state: dict[str, Any],
    score: float | None,
) -> Path:
    with timed("checkpoint"):
        return checkpoints.save(step, session.weights(), {"step": step, **state}, score)
