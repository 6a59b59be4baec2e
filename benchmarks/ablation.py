"""What each part of the recipe is worth: `config/run.yaml` with one change at a time.

    python -m benchmarks.ablation [--page docs/recipe.md]

Each row is trained from scratch for the same number of steps with each seed, and evaluated with
`trainers.evaluate`. Each run leaves a file of results, and what is there is not trained again.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.jobs import ROOT, Job, run_missing
from benchmarks.page import markdown, write_between

RUN_FILE = ROOT / "config" / "run.yaml"
HEAD = ("change", "first action", "position (mm)", "yaw (deg)")
PPO = """trainer={
    trainer_type: ppo, summary_freq: 50000, checkpoint_interval: 250000,
    hyperparameters: {batch_size: 1024, buffer_size: 16384, num_epoch: 2, learning_rate: 2e-3,
        learning_rate_schedule: linear, gamma: 0.0, target_kl: 0.3, beta: 0.0},
    network_settings: {hidden_units: 256, num_layers: 2, critic: separate,
        critic_observations: [privileged], initial_std: 0.3, min_std: 0.005}}"""
MORE_REWARDS = """rewards=[
    {type: touch}, {type: collision}, {type: position}, {type: rotation},
    {type: precision, gain: 0.1}]"""
PAPER_REWARDS = """rewards=[
    {type: touch}, {type: collision}, {type: position}, {type: rotation},
    {type: approach, gain: 0.03}, {type: facing, gain: 0.01}]"""


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
    overrides: tuple[str, ...] = ()


CAMERA = "environment.cameras.depth"
HYPER = "trainer.hyperparameters"
CHANGES = (
    Change("none", "none: config/run.yaml"),
    Change(
        "upright",
        "the camera upright, 62° to see as much",
        (f"{CAMERA}.roll_deg=0", f"{CAMERA}.fov_deg=62", f"{CAMERA}.target_m=[1.20, 0.0, 0.68]"),
    ),
    Change(
        "aside",
        "the camera from the side, as `cameras` has it by default",
        (
            f"{CAMERA}={{type: depth, width: 80, height: 80, "
            "range_m: [0.4, 2.0], noise_sigma_m: 0.002}",
        ),
    ),
    Change(
        "paper-encoder",
        "the encoder `paper`, learning rate 1e-3",
        ("encoders.depth={type: paper, size: 80}", f"{HYPER}.learning_rate=1e-3"),
    ),
    Change(
        "image-critic",
        "a critic that sees the image, too, not the true state",
        ("trainer.network_settings.critic_observations=[depth]",),
    ),
    Change("ppo", "PPO instead of DDPG", (PPO,)),
    Change("more-rewards", "`touch`, `position`, `rotation` beside `precision`", (MORE_REWARDS,)),
    Change("paper-rewards", "the paper's rewards, without `precision`", (PAPER_REWARDS,)),
    Change("linear-noise", "noise that falls linearly", (f"{HYPER}.noise.schedule.type=linear",)),
    Change("slower", "learning rate 2e-3", (f"{HYPER}.learning_rate=2e-3",)),
    Change(
        "larger-batches",
        "batches of 512, half as many",
        (f"{HYPER}.batch_size=512", f"{HYPER}.updates_per_step=0.0078125"),
    ),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Trains and evaluates what is missing, and reports on all."""
    options = parse(arguments)
    changes = [change for change in CHANGES if change.slug in options.changes]
    jobs = {
        (change.slug, seed): job_of(change, seed, options.steps, options.results)
        for seed in options.seeds
        for change in changes
    }
    if code := run_missing(list(jobs.values()), options.jobs):
        return code
    reports = {key: json.loads(job.results.read_text()) for key, job in jobs.items()}
    rows = [
        row(change, [reports[change.slug, seed] for seed in options.seeds]) for change in changes
    ]
    table = Table(*HEAD, title=f"{options.steps:,} steps, {len(options.seeds)} seeds")
    for cells in rows:
        table.add_row(*cells)
    Console().print(table)
    if options.page is not None:
        write_between(options.page, "ablation", markdown(HEAD, rows))
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    slugs = [change.slug for change in CHANGES]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablation", description=__doc__)
    parser.add_argument("--changes", nargs="+", choices=slugs, default=slugs)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=300_000, help="of each run")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="at a time")
    parser.add_argument("--results", type=Path, default=Path("results/ablation"), metavar="DIR")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")
    return parser.parse_args(arguments)


def job_of(change: Change, seed: int, steps: int, results: Path) -> Job:
    """Training from scratch with a change, then the evaluation."""
    name, folder = f"{change.slug}-{steps}-{seed}", results.resolve()
    file = folder / f"{name}.json"
    learn = ["-m", "trainers.learn", str(RUN_FILE), *change.overrides]
    # One checkpoint, the last: the best of several would be of another step in every row.
    learn += [f"trainer.max_steps={steps}", f"trainer.checkpoint_interval={steps}"]
    learn += ["--seed", str(seed), "--run-id", name]
    # What an interrupted run left has no results; it begins anew.
    learn += ["--results-dir", str(folder / "runs"), "--force"]
    evaluate = ["-m", "trainers.evaluate", str(folder / "runs" / name), "--json", str(file)]
    return Job(name, (learn, evaluate), file)


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
