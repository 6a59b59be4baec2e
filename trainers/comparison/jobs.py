"""Runs in processes of their own, some at a time; each leaves a file of results."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

CORES = len(os.sched_getaffinity(0))


@dataclass(frozen=True)
class Job:
    """What to run, one command after the other, to have a file of results.

    Attributes:
        name: for people.
        commands: arguments of Python's interpreter.
        results: what the last command writes.
        done: there is nothing to do; None: where the results are.
        folder: where the commands run; None: here.
    """

    name: str
    commands: Sequence[Sequence[str]]
    results: Path
    done: bool | None = None
    folder: Path | None = None

    @property
    def missing(self) -> bool:
        """Whether there is anything to do."""
        return not (self.results.exists() if self.done is None else self.done)


def run_missing(jobs: Sequence[Job], at_once: int) -> int:
    """Does the jobs that are missing, whatever becomes of others; returns the highest exit code.

    Each has one thread: small networks gain little from a second, and jobs go side by side.
    """
    missing = [job for job in jobs if job.missing]
    with ThreadPoolExecutor(at_once) as pool:
        return max(pool.map(_run, missing), default=0)


def _run(job: Job) -> int:
    _say(f"{job.name} begins", sys.stdout)
    job.results.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    for command in job.commands:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=job.folder,
            env=environment,
            check=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        if done.returncode:
            _say(f"{job.name} failed:\n{done.stderr}", sys.stderr)
            return done.returncode
    return 0


def _say(line: str, stream: TextIO) -> None:
    # In one piece: print writes the line's end by itself, and jobs begin side by side.
    stream.write(f"{line}\n")
    stream.flush()
