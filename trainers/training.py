"""The training loop: collect, update, log, advance the lesson, evaluate, save."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

from torch import Tensor

from trainers.algorithms.base import TrainerSettings
from trainers.common.averager import Averager
from trainers.common.errors import NonFiniteError
from trainers.common.stopping import StopRequested
from trainers.common.timers import timed
from trainers.held_out import HeldOutEvaluation
from trainers.reporting.event_log import RunLog
from trainers.reporting.summary import Summary
from trainers.reporting.terminal import TerminalDisplay
from trainers.saving.checkpoint import Checkpoints, Loaded
from trainers.saving.resumable import Resumable
from trainers.session import Session

REWARD, AGE = "reward", "age"
"""Kinds of scores where there are no evaluations; by age means that the newest counts."""
SCORING = "since_checkpoint"
"""Part of the saved state: the episodes that the next checkpoint's reward is the mean of."""

ENDLESS_STEPS = (200, 50_000)
"""Steps in which an episode may be meant to end: the limits of `_endless_from`."""


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
        log: the loggers and status.json.
        summary: gathers statistics for it.
        checkpoints: where the run is saved.
        display: the terminal.
        held_out: evaluates while it learns, if anything does.
        resumed: the checkpoint that the session was taken up from, if it was.
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
        resumed: Loaded | None = None,
    ):
        self._session, self._settings, self._held_out = session, settings, held_out
        self._log, self._summary, self._display = log, summary, display
        self._checkpoints = checkpoints
        self._since_save, self._summary_state = Averager(), summary.state_dict()
        self._saved_step: int | None = None
        self._saved_score: float | None = None
        if resumed is not None:
            self._saved_step, self._saved_score = resumed.step, resumed.score
            if SCORING in resumed.state:  # not in those of former versions
                self._since_save.load_state_dict(resumed.state[SCORING])
        self._told_of_endless = False
        self._finite = _finite(session.weights())  # a buffer of infinities may be meant

    def run(self) -> Ending:
        """Trains until there is reason to end; what was learned is saved, however it ends.

        Raises:
            NonFiniteError: a reward, an observation, a loss or a weight is not finite.
            Exception, SystemExit: whatever an environment or another part raises. The run is saved
                as it was after the last whole update, as after a `NonFiniteError`; a note says so
                where it could not be.
        """
        try:
            return self._run()
        except StopRequested:
            return Ending(False, "stopped, and saved")

    def _run(self) -> Ending:
        env_runner, max_steps = self._session.env_runner, self._settings.max_steps
        interval = self._settings.checkpoint_interval
        # Between an update and the next collection is where a run can be taken up again.
        present = self._resumable()
        if self._saved_step is not None:
            self._save(present)  # its evaluation was cut off, and is made up for
        while env_runner.step_count < max_steps:
            before = present
            with self._saved_if_cut_off(before):
                with timed("collect"):
                    self._session.algorithm.collect()
                copy = before.copied()
                if self._session.world.any(copy is None):
                    copy = None  # then none is stopped half way
            self._update(copy, before.step / max_steps)
            present = self._resumable()
            step = present.step
            with self._saved_if_cut_off(present):
                evaluated = self._evaluate(step)
            if evaluated or step // interval > before.step // interval:
                self._save(present, interval_over=True)
            if evaluated and self._held_out and (reached := self._held_out.target_reached):
                return Ending(True, reached)
        self._save(present)
        return Ending(True, f"max_steps: {max_steps} steps were taken")

    def _resumable(self) -> Resumable:
        """What the run can be taken up from now; what the summary has belongs to it."""
        self._summary_state = self._summary.state_dict()
        return self._session.resumable()

    @contextmanager
    def _saved_if_cut_off(self, good: Resumable | None) -> Iterator[None]:
        """Saves the run where it is stopped, or anything in it fails.

        Args:
            good: what to go on from; None: there is nothing but the last checkpoint.
        """
        try:
            yield
        except StopRequested:
            assert good is not None  # or nothing could be stopped
            self._save(good)
            raise
        except (Exception, SystemExit) as error:
            # Ranks save together, or not at all.
            if good is not None and self._session.world.all_know(error):
                self._save_after(error, good)
            raise

    def _save_after(self, error: BaseException, good: Resumable) -> None:
        """Saves the run; why it can't be is noted, and does not hide what it failed of."""
        try:
            self._save(good)
        except Exception as unsaved:
            error.add_note(f"the run could not be saved: {unsaved}")

    def _update(self, before: Resumable | None, run_fraction: float) -> None:
        """Learns from what was collected; cut off half way, it leaves the run as it was before.

        Without a copy of that it is not stopped half way.
        """
        deaf = self._session.env_runner.unstoppable() if before is None else nullcontext()
        with self._saved_if_cut_off(before), deaf:
            self._learn(run_fraction)

    def _learn(self, run_fraction: float) -> None:
        """Updates, and tells what came of it."""
        session, summary = self._session, self._summary
        self._tell_of_endless()
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
        # Last, as it is part of what is saved where anything above fails.
        if len(episodes):
            self._since_save.add({REWARD: float(episodes.rewards.mean())}, len(episodes))

    def _tell_of_endless(self) -> None:
        """Says once that an episode seems to have no end, which keeps all figures waiting."""
        env_runner = self._session.env_runner
        steps = env_runner.longest_episode
        if self._told_of_endless or steps < self._endless_from:
            return
        self._told_of_endless = True
        self._display.message(
            f"step {env_runner.step_count}: an episode has not ended for {steps} steps, and until "
            "it does, none that began after it counts for rewards, success and lessons; if it has "
            "no end, set a limit: environment.max_episode_steps, where it is gymnasium's"
        )

    @property
    def _endless_from(self) -> float:
        """Steps of an episode that may have no end: a third of what an environment takes in all."""
        least, most = ENDLESS_STEPS
        third = self._settings.max_steps / self._session.env_runner.num_envs / 3
        return max(least, min(most, third))

    def _evaluate(self, step: int) -> bool:
        """Evaluates where it is time to, at each interval and at the run's end; whether it was."""
        held_out = self._held_out
        if held_out is None or not (held_out.due(step) or step >= self._settings.max_steps):
            return False
        held_out.evaluate(step, self._log)
        self._summary.note_evaluation(held_out.latest)
        self._summary.pace.note_evaluation(held_out.took_s)
        return True

    def _save(self, good: Resumable, *, interval_over: bool = False) -> None:
        """Saves the run, unless it is saved already with all that is known of it.

        Raises:
            NonFiniteError: weights are not finite that were; nothing is saved.
        """
        step = good.step
        score, score_of = self._score(step)
        if step == self._saved_step and (score is None or self._saved_score is not None):
            return
        if broken := self._finite - _finite(good.weights):
            raise NonFiniteError(f"step {step}: the weights {min(broken)!r} are not finite")
        if interval_over:
            self._since_save = Averager()
        session = self._session
        with timed("checkpoint"):
            joined = session.joined_state(good.state)
            own = {SCORING: self._since_save.state_dict(), **self._summary_state}
            state = {"step": step, **own, **joined}
            with session.world.together():
                if session.world.writes:
                    path = self._checkpoints.save(step, good.weights, state, score, score_of)
                    self._summary.note_checkpoint(path)
        self._saved_step, self._saved_score = step, score

    def _score(self, step: int) -> tuple[float | None, str]:
        """Score that the best checkpoint is chosen by, if it has one, and what it is a score of.

        By an evaluation of this very policy where there are evaluations. By the mean reward since
        the last interval's checkpoint otherwise; but those of different lessons can't be compared.
        """
        if self._held_out is not None:
            is_of_this = self._held_out.latest["step"] == step
            score_of = f"evaluation.{self._held_out.scored_by}"
            return self._held_out.score if is_of_this else None, score_of
        reward = self._since_save.means().get(REWARD)
        return (reward, REWARD) if self._session.lesson_count == 1 else (None, AGE)


def _finite(weights: Mapping[str, Tensor]) -> set[str]:
    """Names of those that are finite."""
    return {name for name, values in weights.items() if values.isfinite().all()}
