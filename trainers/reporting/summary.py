"""Reports of a run: its loggers, status.json and the terminal."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.environment import Environment
from envs.evaluation import SUCCESS, Figure
from trainers.common.averager import Averager
from trainers.experience.episodes import EpisodeBatch
from trainers.experience.frames import frame_spaces
from trainers.reporting.event_log import RunLog
from trainers.reporting.images import picture
from trainers.reporting.pace import Pace
from trainers.reporting.terminal import RunStatus, TerminalDisplay

REWARD_TAG = "Environment/Cumulative Reward"
SUCCESS_TAG = "Environment/Success Rate"
LENGTH_TAG = "Environment/Episode Length"
SUMMARIES_PER_PICTURE = 10


@dataclass(frozen=True)
class RunPosition:
    """Position of a run.

    Attributes:
        step: environment steps taken.
        lesson: the present lesson, from 0; None without a curriculum.
        lesson_count: lessons of the curriculum; 1 without one.
    """

    step: int
    lesson: int | None = None
    lesson_count: int = 1


SINCE_SUMMARY, LATEST = "since_summary", "latest_summary"
"""Parts of the saved state: what the next summary is the mean of, and what the last one told."""


class Summary:
    """Gathers statistics, and reports them every `summary_freq` steps.

    Args:
        log: the loggers and status.json.
        run_id: the run's name.
        env: what is observed, and how its figures are called.
        max_steps: steps of the whole run.
        summary_freq: steps between two summaries.
        start_step: steps the run had when this process took it up.
        pace: estimates the time left; by default one that knows of no evaluations.
    """

    def __init__(
        self,
        log: RunLog,
        run_id: str,
        env: Environment,
        max_steps: int,
        summary_freq: int,
        start_step: int = 0,
        pace: Pace | None = None,
    ):
        self.pace = pace or Pace(start_step, max_steps)
        self._frame_spaces = frame_spaces(env.single_observation_space)
        self._figures = env.evaluator().figures
        self._log, self._run_id, self._max_steps = log, run_id, max_steps
        self._summary_freq = summary_freq
        self._averager = Averager()
        self._last: dict[str, float] = {}
        self._picture_freq = SUMMARIES_PER_PICTURE * summary_freq
        # A run begins with both; one that is resumed has them when it would have had them.
        self._next_summary = _next_multiple(start_step, summary_freq) if start_step else 0
        self._next_picture = _next_multiple(start_step, self._picture_freq) if start_step else 0
        self._start_s = self._summary_s = time.monotonic()
        self._summary_step = start_step
        self._checkpoint: str | None = None
        self._evaluation: dict[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        """What a run that is resumed goes on with: parts of its saved state."""
        latest = Averager()
        latest.add({tag: self._last[tag] for tag in (REWARD_TAG, SUCCESS_TAG) if tag in self._last})
        return {SINCE_SUMMARY: self._averager.state_dict(), LATEST: latest.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on with it; former versions saved none."""
        latest = Averager()
        for name, averager in ((SINCE_SUMMARY, self._averager), (LATEST, latest)):
            if name in state:
                averager.load_state_dict(state[name])
        self._last = latest.means()

    @property
    def compared_tags(self) -> tuple[str, ...]:
        """The tags of the curves of episodes, whose last points runs are compared by."""
        metrics = (metric_tag(figure.metric, self._figures) for figure in self._figures)
        return (REWARD_TAG, LENGTH_TAG, SUCCESS_TAG, *metrics)

    def add(self, statistics: Mapping[str, float]) -> None:
        """Adds the statistics of an update."""
        self._averager.add(statistics)

    def add_episodes(self, episodes: EpisodeBatch) -> None:
        """Adds finished episodes."""
        if not len(episodes):
            return
        means = {
            REWARD_TAG: episodes.rewards.mean(),
            LENGTH_TAG: episodes.lengths.mean(),
            **{f"Reward/{name}": total.mean() for name, total in episodes.terms.items()},
            **{
                metric_tag(name, self._figures): values.mean()
                for name, values in episodes.episode_metrics.items()
            },
        }
        self._averager.add({name: float(mean) for name, mean in means.items()}, len(episodes))

    def note_checkpoint(self, path: Path) -> None:
        """Keeps the newest checkpoint, for status.json."""
        self._checkpoint = str(path)

    def report(
        self,
        position: RunPosition,
        observations: Mapping[str, NDArray[Any]],
        display: TerminalDisplay,
    ) -> None:
        """Writes a summary if one is due, and shows the terminal where the run stands.

        Args:
            position: how far the run has come.
            observations: by name (N, ...), the present ones, of which images are shown at times.
            display: the terminal.
        """
        self.pace.note_step(position.step)
        if position.step < self._next_summary:
            display.advance(self._line(position))
            return
        self._next_summary = _next_multiple(position.step, self._summary_freq)
        self._summarize(position, observations)
        display.update(self._line(position))

    def note_evaluation(self, report: Mapping[str, Any]) -> None:
        """Keeps the latest evaluation, for status.json."""
        self._evaluation = dict(report)

    def status(self, position: RunPosition, state: str, reason: str | None = None) -> None:
        """Rewrites status.json.

        Args:
            position: how far the run has come.
            state: `running`, `finished`, `interrupted` or `failed`.
            reason: why it is no longer running.
        """
        line = self._line(position)
        self._log.status(
            {
                "run_id": self._run_id,
                "state": state,
                "reason": reason,
                "step": line.step,
                "max_steps": self._max_steps,
                "lesson": line.lesson + 1,
                "lessons": position.lesson_count,
                "reward": line.reward,
                "success": line.success,
                "steps_per_second": line.steps_per_second,
                "elapsed_s": time.monotonic() - self._start_s,
                "last_checkpoint": self._checkpoint,
                "evaluation": self._evaluation,
            }
        )

    def _summarize(self, position: RunPosition, observations: Mapping[str, NDArray[Any]]) -> None:
        step = position.step
        now = time.monotonic()
        means = self._averager.pop_means()
        if step > self._summary_step:
            speed = (step - self._summary_step) / max(now - self._summary_s, 1e-9)
            means["Performance/Steps Per Second"] = speed
        if position.lesson is not None:
            means["Environment/Lesson Number/lesson"] = position.lesson + 1
        self._summary_s, self._summary_step = now, step
        self._log.scalars(means, step)
        if step >= self._next_picture:
            self._next_picture = _next_multiple(step, self._picture_freq)
            self._show_observations(observations, step)
        self._last |= means
        self.status(position, "running")

    def _show_observations(self, observations: Mapping[str, NDArray[Any]], step: int) -> None:
        for name, space in self._frame_spaces.items():
            frame = np.asarray(observations[name][0])
            self._log.image(f"Observations/{name}", picture(space, frame), step)

    def _line(self, position: RunPosition) -> RunStatus:
        return RunStatus(
            step=position.step,
            reward=self._last.get(REWARD_TAG),
            lesson=position.lesson or 0,
            success=self._last.get(SUCCESS_TAG),
            steps_per_second=self._last.get("Performance/Steps Per Second"),
            seconds_left=self.pace.seconds_left,
        )


def metric_tag(metric: str, figures: Sequence[Figure]) -> str:
    """The TensorBoard tag of an episode metric: its figure's name, or its own where it has none."""
    if metric == SUCCESS.metric:
        return SUCCESS_TAG
    name = next((figure.name for figure in figures if figure.metric == metric), metric)
    return f"Environment/{name.replace('_', ' ').title()}"


def _next_multiple(step: int, interval: int) -> int:
    """The first multiple of an interval that is beyond a step."""
    return (step // interval + 1) * interval
