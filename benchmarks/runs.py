"""Runs in processes of their own, some at a time; each leaves a file of results."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Job:
    """What to run, one command after the other, to have a file of results.

    Attributes:
        name: for people.
        commands: arguments of Python's interpreter, from the project's root.
        results: what the last command writes. Where it is, the job is done.
    """

    name: str
    commands: Sequence[Sequence[str]]
    results: Path


def add_options(parser: argparse.ArgumentParser, results: str) -> None:
    """Adds the options of a command that runs jobs and reports on them."""
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="at a time")
    parser.add_argument("--results", type=Path, default=Path(results), metavar="DIR")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")


def run_missing(jobs: Sequence[Job], at_once: int) -> int:
    """Does the jobs that have no results yet; returns the highest exit code.

    Each has one thread: small networks gain little from a second, and jobs go side by side.
    """
    missing = [job for job in jobs if not job.results.exists()]
    with ThreadPoolExecutor(at_once) as pool:
        return max(pool.map(_run, missing), default=0)


def _run(job: Job) -> int:
    print(f"{job.name} begins", flush=True)
    job.results.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    for command in job.commands:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=ROOT,
            env=environment,
            check=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        if done.returncode:
            print(f"{job.name} failed:\n{done.stderr}", file=sys.stderr)
            return done.returncode
    return 0
