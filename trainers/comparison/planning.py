"""The runs that a comparison is of: those that run files ask for, and those made elsewhere."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainers.common.errors import UserError
from trainers.comparison.jobs import Job
from trainers.comparison.report import Experiments
from trainers.comparison.results import RunResult, read_status, read_what_is_left
from trainers.runfile.changes import differences
from trainers.runfile.registry import Registries
from trainers.runfile.settings import dump_yaml, load_run
from trainers.runfile.yaml_document import dotted, parse, read
from trainers.saving.run_folder import CONFIGURATION, has_checkpoints

FINISHED = "finished"
DEVICE = ("device",)
"""Where it was computed makes a run no other one; learn goes on with it on another, too."""


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
        learn = ["-m", "trainers.console", "learn", str(self.config), *self.overrides]
        learn += ["--run-id", self.folder.name, "--results-dir", str(self.folder.parent)]
        done = False
        if (self.folder / CONFIGURATION).is_file():
            found = read(self.folder / CONFIGURATION).data
            changed = [path for path, _, _ in differences(found, asked) if path != DEVICE]
            if changed:
                raise UserError(
                    f"{self.folder}: what is there was made by another run file than {self.config}:"
                    f" {dotted(changed[0])} differs; choose another --results-dir"
                )
            done = read_status(self.folder).get("state") == FINISHED
            learn += ["--resume" if has_checkpoints(self.folder) else "--force"]
        return Job(self.folder.name, [learn], self.folder, done)


def plan(options: argparse.Namespace, paths: Sequence[Path]) -> Iterator[PlannedRun]:
    """The runs that run files ask for, in their order.

    Raises:
        UserError: there is no such file, a folder has none, or two have the same name.
    """
    configs: dict[str, Path] = {}
    for config in _run_files(paths):
        earlier = configs.setdefault(config.stem, config)
        if earlier.resolve() != config.resolve():
            raise UserError(f"{earlier} and {config} have the same name: rename one of them")
    steps = options.max_steps
    overrides = [] if steps is None else [f"trainer.max_steps={steps}"]
    if options.device is not None:
        overrides.append(f"device={options.device}")
    name = "-".join(filter(None, ("{}", steps and str(steps))))
    for stem, config in configs.items():
        for seed in range(options.seeds):
            folder = options.results_dir / f"{name.format(stem)}-{seed}"
            yield PlannedRun(stem, config, [*overrides, f"seed={seed}"], folder)


def runs_in(path: Path) -> list[Path]:
    """A run's folder itself, or those of the runs in a folder; none where it is neither."""
    if (path / CONFIGURATION).is_file():
        return [path]
    return sorted(file.parent for file in path.glob(f"*/{CONFIGURATION}"))


def _run_files(paths: Sequence[Path]) -> Iterator[Path]:
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        files = sorted(path.glob("*.yaml"))
        if not files:
            raise UserError(f"{path}: neither a run (no {CONFIGURATION}) nor a folder of run files")
        yield from files


def jobs_of(planned: Sequence[PlannedRun], registries: Registries) -> list[Job]:
    """What is left to do; what is damaged is left alone, and the report says so.

    Raises:
        UserError: a run file is wrong, or what is there was made by another one.
    """
    return [run.job(registries) for run in planned if _is_readable(run.folder)]


def _is_readable(folder: Path) -> bool:
    if not (folder / CONFIGURATION).is_file():
        return True
    try:
        read(folder / CONFIGURATION)
        read_status(folder)
    except UserError:
        return False
    return True


def collect(planned: Sequence[PlannedRun], made: Sequence[Path]) -> Experiments:
    """What there is of the runs by experiment; of those made elsewhere by their configuration.

    Raises:
        UserError: there is nothing at all.
    """
    experiments: dict[str, list[RunResult]] = {}
    for run in planned:
        experiments.setdefault(run.experiment, []).append(read_what_is_left(run.folder))
    for result in map(read_what_is_left, made):
        experiments.setdefault(_name_of(result, experiments), []).append(result)
    if not any(run.configuration for runs in experiments.values() for run in runs):
        raise UserError("there is nothing to report on: no run has begun")
    return experiments


def _name_of(result: RunResult, known: Mapping[str, Sequence[RunResult]]) -> str:
    """The experiment that a run belongs to: that of runs which differ in their seeds alone."""
    for name, runs in known.items():
        begun = [run for run in runs if run.configuration]
        alike = begun and all(_but_seed(run) == _but_seed(result) for run in begun)
        if alike and result.seed not in (run.seed for run in begun):
            return name
    name = re.sub(rf"[-_]?(seed|s)?{result.seed}$", "", result.folder.name) or result.folder.name
    return name if name not in known else result.folder.name


def _but_seed(result: RunResult) -> dict[str, Any]:
    return {**result.configuration, "seed": None}
