"""Runs in processes of their own, some at a time; each leaves a file of results."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

from trainers.common.cores import usable_cores

CORES = usable_cores()
POLL_S = 1.0
SIGNALLED = 128
"""Exit code of a command that a signal ended, less the signal's number, as shells have it."""
STOPPED = (SIGNALLED + signal.SIGINT, SIGNALLED + signal.SIGTERM)
"""Exit codes of what was told to stop: a run saves itself, and can go on."""


@dataclass(frozen=True)
class Job:
    """What to run, one command after the other, to have a file of results.

    Attributes:
        name: for people.
        commands: arguments of Python's interpreter.
        results: what the last command writes.
        done: there is nothing to do; None: where the results are.
        folder: where the commands run; None: here.
        stop: asked every `POLL_S` seconds whether the command that runs is to stop, by SIGTERM; it
            alone says so: signals of the terminal don't reach the command. None: they do.
    """

    name: str
    commands: Sequence[Sequence[str]]
    results: Path
    done: bool | None = None
    folder: Path | None = None
    stop: Callable[[], bool] | None = None

    @property
    def missing(self) -> bool:
        """Whether there is anything to do."""
        return not (self.results.exists() if self.done is None else self.done)


@dataclass(frozen=True)
class Ended:
    """How a job ended.

    Attributes:
        code: exit code of the last command that ran, as a shell says it.
        errors: what that wrote to its standard error.
    """

    code: int
    errors: str


def run_missing(jobs: Sequence[Job], at_once: int, stop: Callable[[], bool] | None = None) -> int:
    """Does the jobs that are missing, whatever becomes of others; returns the highest exit code.

    Each has one thread: small networks gain little from a second, and jobs go side by side.

    Args:
        jobs: what to do; their own `stop` is not asked.
        at_once: so many at a time.
        stop: asked whether to stop what runs, and to begin no more; see `Job`.
    """

    def run_unless_stopped(job: Job) -> Ended:
        if stop is not None and stop():
            return Ended(max(STOPPED), "")
        return run(replace(job, stop=stop))

    missing = [job for job in jobs if job.missing]
    with ThreadPoolExecutor(at_once) as pool:
        return max((ended.code for ended in pool.map(run_unless_stopped, missing)), default=0)


def run(job: Job) -> Ended:
    """Does a job, and tells of its beginning, and of its failure."""
    say(f"{job.name} begins")
    job.results.parent.mkdir(parents=True, exist_ok=True)
    ended = Ended(0, "")
    for command in job.commands:
        ended = _execute(command, job)
        if ended.code:
            break
    if ended.code not in (0, *STOPPED):
        say(f"{job.name} failed:\n{ended.errors}", sys.stderr)
    return ended


def _execute(command: Sequence[str], job: Job) -> Ended:
    """Runs a command to its end."""
    process = subprocess.Popen(
        [sys.executable, *command],
        cwd=job.folder,
        env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # Ctrl-C is for all of the terminal's group: with the SIGTERM that follows it, it would be
        # a second signal, by which a run stops without saving.
        process_group=None if job.stop is None else 0,
    )
    stopped = False
    try:
        while True:
            try:
                _, errors = process.communicate(timeout=POLL_S)
            except subprocess.TimeoutExpired:
                if not stopped and job.stop is not None and job.stop():
                    process.terminate()
                    stopped = True
            else:
                code = process.returncode
                return Ended(code if code >= 0 else SIGNALLED - code, errors)
    finally:
        process.terminate()  # where asking failed; it does nothing to one that has ended


def say(line: str, stream: TextIO | None = None) -> None:
    """Prints a line in one piece: print writes its end by itself, and jobs go side by side."""
    stream = stream or sys.stdout
    stream.write(f"{line}\n")
    stream.flush()
