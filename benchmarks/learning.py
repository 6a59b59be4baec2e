"""Who learns better: our algorithms and their peers on the same tasks, with the same settings.

`python -m benchmarks.learning` trains PPO, TRPO and DDPG and their counterparts of
Stable-Baselines3 and sb3-contrib with the hyper-parameters of `config/gymnasium/`, several seeds
each, and evaluates both in the same way. Each run leaves a file of results, and what is there is
not trained again. Needs the extra `bench`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.contest.cases import CASES, SIDES, Case, Job
from benchmarks.contest.report import draw, summaries, table, write_page

ROOT = Path(__file__).parents[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Trains what is missing, and reports on all."""
    options = parse(arguments)
    cases = [
        case
        for case in CASES
        if case.algorithm in options.algorithms and case.task in options.tasks
    ]
    # Side by side with its peer, so that both meet the same moods of the machine.
    jobs = [Job(case, side, seed) for case in cases for seed in options.seeds for side in SIDES]
    missing = [job for job in jobs if not _file(options.results, job).exists()]
    options.results.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(options.jobs) as pool:
        codes = list(pool.map(lambda job: _run(job, options.results), missing))
    return max(codes, default=0) or report(options, jobs)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    algorithms = sorted({case.algorithm for case in CASES})
    tasks = sorted({case.task for case in CASES})
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning", description=__doc__)
    parser.add_argument("--algorithms", nargs="+", choices=algorithms, default=algorithms)
    parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="at a time")
    parser.add_argument("--results", type=Path, default=Path("results/learning"), metavar="DIR")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="draw the learning curves")
    return parser.parse_args(arguments)


def report(options: argparse.Namespace, jobs: Sequence[Job]) -> int:
    """Prints the table, and writes page and pictures where asked."""
    results: list[dict[str, Any]] = [
        json.loads(_file(options.results, job).read_text()) for job in jobs
    ]
    found = summaries(results)
    Console().print(table(found))
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
        draw(results, options.pictures)
    if options.page is not None:
        write_page(options.page, found, len(options.seeds))
    return 0


def _run(job: Job, results: Path) -> int:
    """Does a job in a process of its own; returns its exit code."""
    case: Case = job.case
    command = [sys.executable, "-m", "benchmarks.contest.run", case.algorithm, case.task]
    command += [str(case.steps), job.side, str(job.seed), "--to", str(_file(results, job))]
    print(f"{job.name} begins", flush=True)
    done = subprocess.run(command, cwd=ROOT, check=False, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        print(f"{job.name} failed:\n{done.stderr}", file=sys.stderr)
    return done.returncode


def _file(results: Path, job: Job) -> Path:
    return results.resolve() / f"{job.name}.json"


if __name__ == "__main__":
    raise SystemExit(main())
