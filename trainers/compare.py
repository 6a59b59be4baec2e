"""The command line: `python -m trainers.compare config/paper --seeds 3`."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainers.common.command import DONE, FAILED, require_extra, tells_failures
from trainers.common.errors import UserError
from trainers.comparison.jobs import CORES, Job, run_missing
from trainers.comparison.report import Experiments, write_report
from trainers.comparison.results import RunResult, read_run, read_status
from trainers.runfile.changes import differences
from trainers.runfile.registry import Registries, load_registries
from trainers.runfile.settings import dump_yaml, load_run
from trainers.runfile.yaml_document import dotted, parse, read
from trainers.saving.run_folder import CONFIGURATION, has_checkpoints

FINISHED = "finished"


@dataclass(frozen=True)
class PlannedRun:
    """A run that is to be there.

    Attributes:
        experiment: what it is a run of.
        config: its run file.
        overrides: of the run file.
        folder: where it is, or will be.
    """

    experiment: str
    config: Path
    overrides: Sequence[str]
    folder: Path

    def job(self, registries: Registries) -> Job:
        """What is left to do for it.

        Raises:
            UserError: the run file is wrong, or what is there was made by another one.
        """
        asked = parse(dump_yaml(load_run(self.config, self.overrides, registries)), "").data
        learn = ["-m", "trainers.learn", str(self.config), *self.overrides]
        learn += ["--run-id", self.folder.name, "--results-dir", str(self.folder.parent)]
        done = False
        if (self.folder / CONFIGURATION).is_file():
            found = read(self.folder / CONFIGURATION).data
            for path, _, _ in differences(found, asked):
                raise UserError(
                    f"{self.folder}: what is there was made by another run file than {self.config}:"
                    f" {dotted(path)} differs; choose another --results-dir"
                )
            done = read_status(self.folder).get("state") == FINISHED
            learn += ["--resume" if has_checkpoints(self.folder) else "--force"]
        return Job(self.folder.name, [learn], self.folder, done)


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Runs what is missing and reports on all; returns the exit code."""
    options = parse_options(arguments)
    require_extra("render", "matplotlib")
    made = [path for path in options.paths if (path / CONFIGURATION).is_file()]
    planned = list(plan(options, [path for path in options.paths if path not in made]))
    registries = load_registries()
    # All run files are looked at before the first run begins.
    jobs = [run.job(registries) for run in planned]
    try:
        code = run_missing(jobs, options.jobs)
        page = write_report(collect(planned, made), options.report or options.results_dir)
    except OSError as error:
        raise UserError(f"{error.filename}: can't be written: {error.strerror}") from error
    print(page)
    return FAILED if code else DONE


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m trainers.compare",
        description="Run experiments with several seeds each, and put them side by side.",
    )
    parser.add_argument(
        "paths",
        nargs="+",
        type=Path,
        metavar="CONFIG_OR_FOLDER",
        help="run files, folders of them, or the folders of runs made elsewhere",
    )
    parser.add_argument("--seeds", type=positive, default=3, help="runs of each run file")
    parser.add_argument("--max-steps", type=positive, help="overrides trainer.max_steps")
    parser.add_argument("--jobs", type=positive, default=CORES, help="runs at a time")
    parser.add_argument("--report", type=Path, metavar="FOLDER", help="default: with the runs")
    parser.add_argument(
        "--results-dir", type=Path, default=Path("results/compare"), help="where runs are kept"
    )
    return parser.parse_intermixed_args(arguments)


def positive(text: str) -> int:
    """A count, as the command line has it."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"should be a whole number from 1, not {text!r}")
    return int(text)


def plan(options: argparse.Namespace, paths: Sequence[Path]) -> Iterator[PlannedRun]:
    """The runs that run files ask for, in their order.

    Raises:
        UserError: there is no such file, a folder has none, or two have the same name.
    """
    configs: dict[str, Path] = {}
    for config in _run_files(paths):
        earlier = configs.setdefault(config.stem, config)
        if earlier is not config:
            raise UserError(f"{earlier} and {config} have the same name: rename one of them")
    steps = options.max_steps
    overrides = [] if steps is None else [f"trainer.max_steps={steps}"]
    name = "-".join(filter(None, ("{}", steps and str(steps))))
    for stem, config in configs.items():
        for seed in range(options.seeds):
            folder = options.results_dir / f"{name.format(stem)}-{seed}"
            yield PlannedRun(stem, config, [*overrides, f"seed={seed}"], folder)


def _run_files(paths: Sequence[Path]) -> Iterator[Path]:
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        files = sorted(path.glob("*.yaml"))
        if not files:
            raise UserError(f"{path}: neither a run (no {CONFIGURATION}) nor a folder of run files")
        yield from files


def collect(planned: Sequence[PlannedRun], made: Sequence[Path]) -> Experiments:
    """What there is of the runs by experiment; of those made elsewhere by their configuration.

    Raises:
        UserError: a run's files can't be read, or there is nothing at all.
    """
    experiments: dict[str, list[RunResult]] = {}
    for run in planned:
        if (run.folder / CONFIGURATION).is_file():
            experiments.setdefault(run.experiment, []).append(read_run(run.folder))
    for result in map(read_run, made):
        experiments.setdefault(_name_of(result, experiments), []).append(result)
    if not experiments:
        raise UserError("there is nothing to report on: no run has begun")
    return experiments


def _name_of(result: RunResult, known: Mapping[str, Sequence[RunResult]]) -> str:
    """The experiment that a run belongs to: that of a run which differs in its seed alone."""
    for name, runs in known.items():
        if _but_seed(runs[0]) == _but_seed(result):
            return name
    name = re.sub(rf"[-_]?(seed|s)?{result.seed}$", "", result.folder.name) or result.folder.name
    return name if name not in known else result.folder.name


def _but_seed(result: RunResult) -> dict[str, Any]:
    return {**result.configuration, "seed": None}


if __name__ == "__main__":
    sys.exit(main())
