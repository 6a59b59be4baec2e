"""Trials of a sweep: runs of `trainers.learn` that are watched, and what becomes of each."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock

import optuna
from optuna.trial import TrialState

from trainers.common.errors import UserError
from trainers.comparison.jobs import STOPPED, Ended, run, say
from trainers.comparison.planning import PlannedRun
from trainers.comparison.results import Curves, read_status
from trainers.held_out import BEST_BY
from trainers.reporting.figures import evaluation_tag
from trainers.runfile.registry import Registries
from trainers.saving.run_folder import CONFIGURATION
from trainers.saving.run_lock import RunLock
from trainers.sweep.plan import Sweep
from trainers.sweep.study import distributions

SCORE, STEPS, REASON, FOLDER = "score", "steps", "reason", "folder"
"""What a study keeps of a trial beside its values: by which figure it was judged, how far it came,
why it ended early, and where its run is."""
RUNNING = "running"


@dataclass(frozen=True)
class Begun:
    """A trial that this process runs, and the lock that says so."""

    trial: optuna.Trial
    lock: RunLock


class Trials:
    """Trials of a sweep, as many at a time as are asked for.

    A trial is this process's while its lock, `running/<trial>`, is held. Where a process was ended
    before its trials, the locks' files stay, and the next one that comes here goes on with them.

    Args:
        sweep: what is tried.
        study: whose trials they are.
        folder: where their runs are kept.
        registries: for their run files.
        stop_requested: asked often; then trials that run are stopped and saved, to be gone on with.
    """

    def __init__(
        self,
        sweep: Sweep,
        study: optuna.Study,
        folder: Path,
        registries: Registries,
        stop_requested: Callable[[], bool],
    ):
        self._sweep, self._study, self._folder = sweep, study, folder
        self._registries, self._stop_requested = registries, stop_requested
        self._distributions = distributions(sweep)
        self._lock = Lock()

    def run(self, count: int, at_once: int) -> None:
        """Goes on with what was left, and begins others until the study has so many.

        Processes that ask at the same time may together begin one more each.
        """
        (self._folder / RUNNING).mkdir(parents=True, exist_ok=True)
        left = deque(self._left())
        with ThreadPoolExecutor(at_once) as pool:
            for worker in [pool.submit(self._work, left, count) for _ in range(at_once)]:
                worker.result()

    def _work(self, left: deque[Begun], count: int) -> None:
        while not self._stop_requested():
            with self._lock:
                begun = left.popleft() if left else self._ask(count)
            if begun is None:
                return
            self._run(begun)

    def _left(self) -> list[Begun]:
        """Trials that were cut off here, and that nobody else has gone on with."""
        found = []
        for place in sorted((self._folder / RUNNING).iterdir()):
            try:
                lock = RunLock(place)
            except UserError:
                continue
            try:
                RunLock(self._folder / place.name).close()  # its run may outlive its sweep
            except UserError:
                lock.close()
                continue
            # Only now: before, another process could still have ended it.
            trials = self._study.get_trials(deepcopy=False)
            trial = next((each for each in trials if _name(each.number) == place.name), None)
            if trial is not None and trial.state is TrialState.RUNNING:
                found.append(Begun(optuna.Trial(self._study, trial._trial_id), lock))
            else:
                self._release(place.name, lock)
        return found

    def _ask(self, count: int) -> Begun | None:
        """A new trial; None where there are enough."""
        while len(self._study.get_trials(deepcopy=False)) < count:
            trial = self._study.ask(self._distributions)
            # Another process that has just begun may take it for one that was left.
            with suppress(UserError):
                return Begun(trial, RunLock(self._folder / RUNNING / _name(trial.number)))
        return None

    def _run(self, begun: Begun) -> None:
        trial, name = begun.trial, _name(begun.trial.number)
        folder = self._folder / name
        trial.set_user_attr(FOLDER, str(folder))
        overrides = self._sweep.overrides(trial.params)
        watch = Watch(trial, folder, self._sweep.evaluation.interval, self._stop_requested)
        try:
            job = PlannedRun(name, self._sweep.base, overrides, folder).job(self._registries)
            job = replace(job, stop=watch)
            ended = run(job) if job.missing else Ended(0, "")
            watch.report()
        except UserError as mistake:
            ended = Ended(1, f"error: {mistake}")
        if ended.code in STOPPED and not watch.pruned:
            return  # the lock's file stays: the trial goes on another time
        self._tell(trial, ended, watch)
        self._release(name, begun.lock)

    def _release(self, name: str, lock: RunLock) -> None:
        """Gives an ended trial's lock up, with its place, which a process before may have made."""
        lock.close()
        with suppress(OSError):  # another process removes it, or looks at what was left there
            (self._folder / RUNNING / name).rmdir()

    def _tell(self, trial: optuna.Trial, ended: Ended, watch: Watch) -> None:
        """Ends a trial in the study."""
        name = _name(trial.number)
        trial.set_user_attr(STEPS, read_status(self._folder / name).get("step", 0))
        trial.set_user_attr(SCORE, watch.score)
        at = f"{watch.score} {watch.value:.4g}"
        if ended.code == 0:
            self._study.tell(trial, watch.value)
            say(f"{name}: {at}")
            return
        state, reason = TrialState.FAIL, _reason(ended)
        if watch.pruned:
            state, reason = TrialState.PRUNED, at
        trial.set_user_attr(REASON, reason)
        self._study.tell(trial, state=state)
        say(f"{name}: {'pruned' if watch.pruned else 'broken'}: {reason}")


class Watch:
    """Tells a study of a trial's held-out evaluations while it runs, and when it is to stop.

    Evaluations are counted by their intervals, from 1: those of trials with different buffers are
    not at the same steps.

    Args:
        trial: which one.
        folder: of its run.
        interval: steps between two evaluations.
        stop_requested: whether it is to stop though it does well.

    Attributes:
        pruned: whether the study's pruner has stopped it.
        score: figure that it is judged by; None before there is any.
        value: that figure, as it was last.
    """

    def __init__(
        self,
        trial: optuna.Trial,
        folder: Path,
        interval: int,
        stop_requested: Callable[[], bool] = lambda: False,
    ):
        self._trial, self._folder, self._interval = trial, folder, interval
        self._stop_requested = stop_requested
        known = trial.study.get_trials(deepcopy=False)[trial.number]
        self._reported = set(known.intermediate_values)
        self._curves: Curves | None = None
        self.pruned = False
        self.score: str | None = None
        self.value = float("nan")

    def __call__(self) -> bool:
        """Whether the trial is to stop."""
        if self._stop_requested():
            return True
        self.pruned = self.pruned or (self.report() and self._trial.should_prune())
        return self.pruned

    def report(self) -> bool:
        """Tells of evaluations that are new; whether there are any."""
        reported = len(self._reported)
        for step, value in self._scores():
            number, self.value = step // self._interval, value
            if number > 0 and number not in self._reported:
                self._trial.report(value, number)
                self._reported.add(number)
        return len(self._reported) > reported

    def _scores(self) -> list[tuple[int, float]]:
        """Steps and scores of the evaluations up to now."""
        if not (self._folder / CONFIGURATION).is_file():
            return []
        if self._curves is None:
            self._curves = Curves(self._folder)
        self._curves.reload()
        tags = self._curves.tags
        self.score = next((name for name in BEST_BY if evaluation_tag(name) in tags), None)
        if self.score is None:
            return []
        steps, values = self._curves.curve(evaluation_tag(self.score))
        return list(zip(steps.tolist(), values.tolist(), strict=True))


def _name(number: int) -> str:
    """Of a trial, and of its run's folder."""
    return f"trial-{number:04d}"


def _reason(ended: Ended) -> str:
    """Why a run broke, in a line."""
    lines = ended.errors.strip().splitlines() or [f"exit code {ended.code}"]
    found = next((line for line in lines if line.startswith("error: ")), lines[-1])
    return found.removeprefix("error: ")
