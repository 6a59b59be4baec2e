"""What each part of a recipe is worth: a run file with one change at a time.

    python -m benchmarks.ablation [run | structured_light] [--page docs/recipe.md]

The run files are those of `config/`, the changes are in `benchmarks/ablation.yaml`. Each row is
trained from scratch for the same number of steps with each seed, and evaluated with
`trainers.evaluate`. Each run leaves a file of results, and what is there is not trained again.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from benchmarks.command import ROOT, add_options, run_unless_stopped
from benchmarks.tables import table, write_between
from trainers.common.command import tells_failures
from trainers.common.errors import UserError
from trainers.comparison.jobs import Job
from trainers.comparison.tables import markdown

RUN_FILES = ROOT / "config"
CHANGES_FILE = Path(__file__).with_suffix(".yaml")
HEAD = ("change", "first action", "position (mm)", "yaw (deg)")


@dataclass(frozen=True)
class Change:
    """A row of the table.

    Attributes:
        slug: in names of files.
        text: for people.
        overrides: of the run file.
    """

    slug: str
    text: str
    overrides: Sequence[str]


@dataclass(frozen=True)
class Recipe:
    """A run file, and what is changed in it.

    Attributes:
        name: of the run file, without its ending.
        evaluated: overrides of all evaluations.
        changes: by their slugs, in the order of the table.
    """

    name: str
    evaluated: Sequence[str]
    changes: Mapping[str, Change]

    @property
    def run_file(self) -> Path:
        """Where it is."""
        return RUN_FILES / f"{self.name}.yaml"


def load_recipes() -> dict[str, Recipe]:
    """The recipes by their names."""
    return {
        name: Recipe(
            name,
            entry["evaluated"],
            {slug: Change(slug, **change) for slug, change in entry["changes"].items()},
        )
        for name, entry in yaml.safe_load(CHANGES_FILE.read_text()).items()
    }


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Trains and evaluates what is missing, and reports on all."""
    options = parse(arguments)
    recipe, changes = options.recipe, options.changes
    jobs = {
        (change.slug, seed): job_of(
            recipe, change, seed, options.steps, options.results, options.device
        )
        for seed in options.seeds
        for change in changes
    }
    if code := run_unless_stopped(list(jobs.values()), options.jobs):
        return code
    reports = {key: json.loads(job.results.read_text()) for key, job in jobs.items()}
    rows = [
        row(change, [reports[change.slug, seed] for seed in options.seeds]) for change in changes
    ]
    title = f"{recipe.name}: {options.steps:,} steps, {len(options.seeds)} seeds"
    Console().print(table(title, HEAD, rows))
    if options.page is not None:
        write_between(options.page, f"ablation {recipe.name}", markdown(HEAD, rows))
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line; `recipe` and `changes` are what is named.

    Raises:
        UserError: the recipe has no such change.
    """
    recipes = load_recipes()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablation", description=__doc__)
    parser.add_argument("recipe", nargs="?", choices=recipes, default="run", help="a run file")
    parser.add_argument("--changes", nargs="+", metavar="NAME", help="default: all there are")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=300_000, help="of each run")
    parser.add_argument("--device", default="cpu", help="where networks train")
    add_options(parser, "results/ablation")
    options = parser.parse_intermixed_args(arguments)
    options.recipe = recipe = recipes[options.recipe]
    slugs = options.changes or list(recipe.changes)
    for slug in slugs:
        if slug not in recipe.changes:
            raise UserError(f"--changes: no {slug!r} in {', '.join(recipe.changes)}")
    options.changes = [recipe.changes[slug] for slug in recipe.changes if slug in slugs]
    return options


def job_of(
    recipe: Recipe, change: Change, seed: int, steps: int, results: Path, device: str = "cpu"
) -> Job:
    """Training from scratch with a change, then the evaluation."""
    name, folder = f"{recipe.name}-{change.slug}-{steps}-{seed}", results.resolve()
    file = folder / f"{name}.json"
    learn = ["-m", "trainers.learn", str(recipe.run_file), *change.overrides]
    # One checkpoint, the last: the best of several would be of another step in every row.
    learn += [f"trainer.max_steps={steps}", f"trainer.checkpoint_interval={steps}"]
    learn += ["--seed", str(seed), "--run-id", name, f"device={device}"]
    # What an interrupted run left has no results; it begins anew.
    learn += ["--results-dir", str(folder / "runs"), "--force"]
    evaluate = ["-m", "trainers.evaluate", str(folder / "runs" / name), *recipe.evaluated]
    evaluate += ["--json", str(file)]
    return Job(name, (learn, evaluate), file, folder=ROOT)


def row(change: Change, reports: Sequence[dict[str, Any]]) -> list[str]:
    """The means over the seeds, and the lowest and highest success."""
    success = [100.0 * report["first_action_success"] for report in reports]

    def mean(name: str, part: str) -> float:
        return statistics.mean(report[name][part] for report in reports)

    position = [1000.0 * mean("position_error_m", part) for part in ("median", "p95")]
    yaw = [mean("yaw_error_deg", part) for part in ("median", "p95")]
    return [
        change.text,
        f"{statistics.mean(success):.1f} % ({min(success):.1f} to {max(success):.1f})",
        f"{position[0]:.1f} / {position[1]:.1f}",
        f"{yaw[0]:.2f} / {yaw[1]:.2f}",
    ]


if __name__ == "__main__":
    raise SystemExit(main())
