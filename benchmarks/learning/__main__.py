"""Who learns better: our algorithms and their peers on the same tasks, with the same settings.

`python -m benchmarks.learning` trains PPO, TRPO, DDPG and SAC and their counterparts of
Stable-Baselines3 and sb3-contrib with the hyper-parameters of our run files, several seeds each,
and evaluates both in the same way. Each run leaves a file of results, and what is there is not
trained again; `--long` does the same with as many steps as MuJoCo's tasks usually get. Needs the
extra `bench`; SAC is a plugin, and left out where it is not installed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.command import EXTRA, ROOT, add_options, run_unless_stopped
from benchmarks.learning.cases import CASES, LONG_CASES, PLUGINS, SIDES, Entry
from benchmarks.learning.report import HEAD, draw, rows
from benchmarks.tables import table, write_between
from trainers.common.command import require_extra, tells_failures
from trainers.common.errors import UserError
from trainers.comparison.jobs import Job
from trainers.comparison.tables import markdown
from trainers.runfile.registry import load_registries


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Trains what is missing, and reports on all."""
    options = parse(arguments)
    algorithms = trainable(options.algorithms)
    require_extra(EXTRA, "scipy", "matplotlib")
    # Side by side with its peer, so that both meet the same moods of the machine.
    jobs = [
        _job(Entry(case, side, seed), options.results)
        for case in (LONG_CASES if options.long else CASES)
        if case.algorithm in algorithms and case.task in options.tasks
        for seed in options.seeds or range(case.seeds)
        for side in SIDES
    ]
    if not all(job.results.exists() for job in jobs):
        require_extra(EXTRA, "stable_baselines3", "sb3_contrib", "mujoco")
    return run_unless_stopped(jobs, options.jobs) or report(options, jobs)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    algorithms = sorted({case.algorithm for case in CASES + LONG_CASES})
    tasks = sorted({case.task for case in CASES + LONG_CASES})
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning", description=__doc__)
    parser.add_argument(
        "--algorithms", nargs="+", choices=algorithms, help="default: all there are"
    )
    parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks)
    parser.add_argument("--seeds", nargs="+", type=int, help="instead of each case's own")
    parser.add_argument("--long", action="store_true", help="up to a million steps each")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="draw the learning curves")
    add_options(parser, "results/learning")
    return parser.parse_args(arguments)


def trainable(asked: Sequence[str] | None) -> set[str]:
    """The algorithms to train: those asked for, or by default all that are installed.

    Raises:
        UserError: one that was asked for is a plugin that is not installed.
    """
    absent = set(PLUGINS) - set(load_registries().trainers.entries)
    for name in sorted(absent & set(asked or PLUGINS)):
        install = f"the trainer {name!r} is not installed: pip install -e {PLUGINS[name]}"
        if asked:
            raise UserError(install)
        print(f"{name} is left out, for {install}")
    return set(asked or (case.algorithm for case in CASES)) - absent


def report(options: argparse.Namespace, jobs: Sequence[Job]) -> int:
    """Prints the table, and writes page and pictures where asked."""
    results = [json.loads(job.results.read_text()) for job in jobs]
    found, name = rows(results), "learning_long" if options.long else "learning"
    title = "mean final return (95 % confidence) and steps/s while training"
    Console().print(table(title, HEAD, found))
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
        draw(results, options.pictures, name)
    if options.page is not None:
        write_between(options.page, name.replace("_", " "), markdown(HEAD, found))
    return 0


def _job(entry: Entry, results: Path) -> Job:
    """One run of one side, in a process of its own."""
    case, file = entry.case, results.resolve() / f"{entry.name}.json"
    command = ["-m", "benchmarks.learning.run", case.algorithm, case.task, str(case.steps)]
    return Job(entry.name, [[*command, entry.side, str(entry.seed), str(file)]], file, folder=ROOT)


if __name__ == "__main__":
    raise SystemExit(main())
