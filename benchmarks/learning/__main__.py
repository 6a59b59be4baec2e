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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.jobs import Job, run_missing
from benchmarks.learning.cases import CASES, SIDES, Entry
from benchmarks.learning.report import draw, summaries, table, write_page


def main(arguments: Sequence[str] | None = None) -> int:
    """Trains what is missing, and reports on all."""
    options = parse(arguments)
    cases = [
        case
        for case in CASES
        if case.algorithm in options.algorithms and case.task in options.tasks
    ]
    # Side by side with its peer, so that both meet the same moods of the machine.
    entries = [
        Entry(case, side, seed)
        for case in cases
        for seed in options.seeds or range(case.seeds)
        for side in SIDES
    ]
    code = run_missing([_job(entry, options.results) for entry in entries], options.jobs)
    return code or report(options, entries)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    algorithms = sorted({case.algorithm for case in CASES})
    tasks = sorted({case.task for case in CASES})
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning", description=__doc__)
    parser.add_argument("--algorithms", nargs="+", choices=algorithms, default=algorithms)
    parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks)
    parser.add_argument("--seeds", nargs="+", type=int, help="instead of each case's own")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="at a time")
    parser.add_argument("--results", type=Path, default=Path("results/learning"), metavar="DIR")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="draw the learning curves")
    return parser.parse_args(arguments)


def report(options: argparse.Namespace, entries: Sequence[Entry]) -> int:
    """Prints the table, and writes page and pictures where asked."""
    results: list[dict[str, Any]] = [
        json.loads(_job(entry, options.results).results.read_text()) for entry in entries
    ]
    found = summaries(results)
    Console().print(table(found))
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
        draw(results, options.pictures)
    if options.page is not None:
        write_page(options.page, found)
    return 0


def _job(entry: Entry, results: Path) -> Job:
    """One run of one side, in a process of its own."""
    case, file = entry.case, results.resolve() / f"{entry.name}.json"
    command = ["-m", "benchmarks.learning.run", case.algorithm, case.task, str(case.steps)]
    command += [entry.side, str(entry.seed), "--to", str(file)]
    return Job(entry.name, [command], file)


if __name__ == "__main__":
    raise SystemExit(main())
