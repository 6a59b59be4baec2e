"""What a run tells its user: TensorBoard, status.json and the terminal."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trainers.common.averager import Averager
from trainers.experience.episodes import SUCCESS, EpisodeBatch
from trainers.experience.frames import frame_spaces
from trainers.reporting.event_log import RunLog
from trainers.reporting.images import picture
from trainers.reporting.terminal import RunStatus, TerminalDisplay
from trainers.session import Session

MEASURE_TAGS = {"success": "Success Rate", "collision": "Collision Rate"}
SUMMARIES_PER_PICTURE = 10


class Summary:
    """Gathers statistics, and reports them every `summary_freq` steps.

    Args:
        log: TensorBoard and status.json.
        run_id: the run's name.
        max_steps: steps of the whole run.
        summary_freq: steps between two summaries.
        start_step: steps the run had when this process took it up.

    Attributes:
        score: how good the policy was at the last summary: the lesson plus the success rate, or,
            where success is not reported, the mean cumulative reward. None before the first.
    """

    def __init__(
        self, log: RunLog, run_id: str, max_steps: int, summary_freq: int, start_step: int = 0
    ):
        self._log, self._run_id, self._max_steps = log, run_id, max_steps
        self._summary_freq, self._start_step = summary_freq, start_step
        self._averager = Averager()
        self._last: dict[str, float] = {}
        self._summaries = 0
        self._next_summary = start_step
        self._start_s = self._summary_s = time.monotonic()
        self._summary_step = start_step
        self._checkpoint: str | None = None
        self.score: float | None = None

    def add(self, statistics: Mapping[str, float]) -> None:
        """Adds the statistics of an update."""
        self._averager.add(statistics)

    def add_episodes(self, episodes: EpisodeBatch) -> None:
        """Adds finished episodes."""
        if not len(episodes):
            return
        means = {
            "Environment/Cumulative Reward": episodes.rewards.mean(),
            "Environment/Episode Length": episodes.lengths.mean(),
            **{f"Reward/{name}": total.mean() for name, total in episodes.terms.items()},
            **{
                measure_tag(name): values.mean()
                for name, values in episodes.episode_metrics.items()
            },
        }
        self._averager.add({name: float(mean) for name, mean in means.items()}, len(episodes))

    def note_checkpoint(self, path: Path) -> None:
        """Remembers the newest checkpoint, for status.json."""
        self._checkpoint = str(path)

    def report(self, session: Session, display: TerminalDisplay) -> None:
        """Writes a summary if one is due, and shows the terminal where the run stands."""
        step = session.env_runner.step_count
        if step >= self._next_summary:
            self._next_summary = (step // self._summary_freq + 1) * self._summary_freq
            self._summarize(session, step)
            display.update(self._line(session, step))

    def status(self, session: Session, state: str) -> None:
        """Rewrites status.json.

        Args:
            session: the run.
            state: `running`, `finished`, `interrupted` or `failed`.
        """
        line = self._line(session, session.env_runner.step_count)
        self._log.status(
            {
                "run_id": self._run_id,
                "state": state,
                "step": line.step,
                "max_steps": self._max_steps,
                "lesson": line.lesson + 1,
                "lessons": session.lesson_count,
                "reward": line.reward,
                "success": line.success,
                "steps_per_second": line.steps_per_second,
                "elapsed_s": time.monotonic() - self._start_s,
                "last_checkpoint": self._checkpoint,
            }
        )

    def _summarize(self, session: Session, step: int) -> None:
        now = time.monotonic()
        means = self._averager.pop_means()
        if step > self._summary_step:
            speed = (step - self._summary_step) / max(now - self._summary_s, 1e-9)
            means["Performance/Steps Per Second"] = speed
        if session.curriculum is not None:
            means["Environment/Lesson Number/lesson"] = session.lesson + 1
        self._summary_s, self._summary_step = now, step
        self._log.scalars(means, step)
        if self._summaries % SUMMARIES_PER_PICTURE == 0:
            self._show_observations(session, step)
        self._summaries += 1
        self._last |= means
        success, reward = self._last_success(), self._last.get("Environment/Cumulative Reward")
        self.score = reward if success is None else session.lesson + success
        self.status(session, "running")

    def _show_observations(self, session: Session, step: int) -> None:
        env_runner = session.env_runner
        spaces: Any = env_runner.env.single_observation_space
        for name, space in frame_spaces(spaces).items():
            frame = np.asarray(env_runner.observations[name][0])
            self._log.images(f"Observations/{name}", picture(space, frame), step)

    def _line(self, session: Session, step: int) -> RunStatus:
        elapsed_s = time.monotonic() - self._start_s
        overall = (step - self._start_step) / max(elapsed_s, 1e-9)
        left_s = (self._max_steps - step) / overall if overall > 0 else None
        return RunStatus(
            step=step,
            reward=self._last.get("Environment/Cumulative Reward"),
            lesson=session.lesson,
            success=self._last_success(),
            steps_per_second=self._last.get("Performance/Steps Per Second"),
            seconds_left=None if left_s is None else max(left_s, 0.0),
        )

    def _last_success(self) -> float | None:
        return self._last.get(measure_tag(SUCCESS))


def measure_tag(name: str) -> str:
    """The TensorBoard tag of an episode's measure."""
    return f"Environment/{MEASURE_TAGS.get(name, name.replace('_', ' ').title())}"
