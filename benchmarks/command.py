"""What the commands have in common: their extra, jobs and their results."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from trainers.comparison.jobs import CORES, Job, run_missing
from trainers.learn import stop_on_signals

ROOT = Path(__file__).parents[1]
EXTRA = "bench"
"""Extra of ventosa's that has what is compared with, and draws."""


def torchrun(count: int, *command: str) -> list[str]:
    """The command line that has so many processes of this machine run a module together."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(count)]
    rendezvous = ["--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0"]
    return [*launch, *rendezvous, "-m", *command]


def run_unless_stopped(jobs: Sequence[Job], at_once: int) -> int:
    """Does the jobs that are missing; returns the exit code, by the signal where one came."""
    with stop_on_signals() as stop:
        code = run_missing(jobs, at_once, stop.requested)
    return stop.exit_code if stop.requested() else code


def missing(*packages: str) -> list[str]:
    """Those of the extra's packages that are not installed."""
    return [name for name in packages if importlib.util.find_spec(name) is None]


def add_options(parser: argparse.ArgumentParser, results: str) -> None:
    """Adds the options of a command that runs jobs and reports on them."""
    parser.add_argument("--jobs", type=int, default=CORES, help="at a time")
    parser.add_argument("--results", type=Path, default=Path(results), metavar="DIR")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")
