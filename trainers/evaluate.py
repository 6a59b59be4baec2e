"""The command line: `python -m trainers.evaluate results/run`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from trainers.common.errors import UserError
from trainers.common.files import write_atomically
from trainers.evaluation import evaluate
from trainers.learn import DONE, MISTAKE

UNITS = {
    "position_error_m": ("mm", 1000.0),
    "yaw_error_deg": ("deg", 1.0),
    "pick_failures": ("%", 100.0),
}
RATES = (
    "success",
    "collision_rate",
    "first_action_success",
    "first_action_collision_rate",
    "pick_rate",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluates a policy; returns the exit code."""
    options = parse(arguments)
    try:
        report = evaluate(
            options.policy,
            episodes=options.episodes,
            seed=options.seed,
            overrides=[f"environment.simulator={options.simulator}"] if options.simulator else [],
            results_dir=options.results_dir,
            pick=options.pick or options.window,
            window=options.window,
            render=options.render,
        )
        text = json.dumps(report, indent=2)
        if options.json is not None:
            try:
                write_atomically(options.json, text + "\n")
            except OSError as error:
                raise UserError(f"{options.json}: can't be written: {error.strerror}") from error
    except UserError as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        return MISTAKE
    Console().print(table(options.policy, report))
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m trainers.evaluate",
        description="Report how good a policy is, on scenes never used for training.",
    )
    parser.add_argument("policy", help="a run (its best checkpoint) or a checkpoint's folder")
    parser.add_argument("--episodes", type=_positive, help="how many (default: the environment's)")
    parser.add_argument("--seed", type=_not_negative, default=0, help="of the scenes")
    parser.add_argument("--simulator", help="overrides `environment.simulator`")
    parser.add_argument(
        "--pick", action="store_true", help="have the robot pick up the block, in PyBullet"
    )
    parser.add_argument(
        "--window", action="store_true", help="pick before your eyes, in PyBullet's window"
    )
    parser.add_argument(
        "--render",
        nargs="?",
        const="",
        metavar="DIR",
        help="draw episodes, errors and a film into DIR (default: evaluation/ in the run's folder)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    parser.add_argument(
        "--results-dir", type=Path, default=Path("results"), help="where runs are kept"
    )
    return parser.parse_args(arguments)


def table(name: str, report: dict[str, Any]) -> Table:
    """The figures for people."""
    result = Table(title=f"{name}: {report['episodes']} episodes, seed {report['seed']}")
    result.add_column("figure")
    result.add_column("value", justify="right")
    for key, value in report.items():
        if key in ("episodes", "seed") or value is None:
            continue
        if isinstance(value, dict):
            unit, factor = UNITS[key]
            for part, number in value.items():
                label = f"{key.rsplit('_', 1)[0]}, {part}".replace("_", " ")
                result.add_row(label, f"{number * factor:.2f} {unit}")
        elif key in RATES:
            result.add_row(key.replace("_", " "), f"{value:.1%}")
        else:
            result.add_row(key.replace("_", " "), f"{value:.3f}")
    return result


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is less than 1")
    return value


def _not_negative(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is negative")
    return value


if __name__ == "__main__":
    sys.exit(main())
