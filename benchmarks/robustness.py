"""What a grasp policy bears: its figures with pixels missing and with more noise.

    python -m benchmarks.robustness policies/grasp [--episodes 1000]

Each row is `trainers.evaluate` on the same scenes with another sensor than the policy was trained
with.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from trainers.common.errors import UserError
from trainers.evaluation import evaluate
from trainers.learn import DONE, MISTAKE

HEAD = ("sensor", "first action", "position (mm)", "yaw (deg)")


@dataclass(frozen=True)
class Fault:
    """A row of the table.

    Attributes:
        text: for people.
        parameters: environment parameters by name, on top of the run's own.
    """

    text: str
    parameters: dict[str, float]

    def overrides(self) -> list[str]:
        """The `KEY=VALUE`s of the run file."""
        return [f"environment_parameters.{name}={value}" for name, value in self.parameters.items()]


FAULTS = (
    Fault("as trained", {}),
    *(
        Fault(f"{share:.1%} of the pixels missing", {"missing_fraction": share})
        for share in (0.001, 0.01, 0.05, 0.1)
    ),
    *(
        Fault(f"noise of {sigma_mm} mm", {"noise_sigma_m": sigma_mm / 1000.0})
        for sigma_mm in (2, 4, 8)
    ),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluates under every fault, and prints the table; returns the exit code."""
    options = parse(arguments)
    table = Table(*HEAD, title=f"{options.policy}: seed {options.seed}")
    try:
        for fault in FAULTS:
            evaluation = evaluate(
                options.policy,
                episodes=options.episodes,
                seed=options.seed,
                overrides=fault.overrides(),
                results_dir=options.results_dir,
            )
            table.add_row(*row(fault, evaluation.report))
    except UserError as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        return MISTAKE
    Console().print(table)
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robustness", description=__doc__)
    parser.add_argument("policy", help="a run (its best checkpoint) or a checkpoint's folder")
    parser.add_argument("--episodes", type=int, default=1000, help="of each row")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes")
    parser.add_argument("--results-dir", type=Path, default=Path("results"))
    return parser.parse_args(arguments)


def row(fault: Fault, report: dict[str, Any]) -> list[str]:
    """The cells of a fault: success, and medians / 95th percentiles of the errors.

    Raises:
        UserError: the policy is none whose first action is to be right.
    """
    if "first_action_success" not in report:
        raise UserError("only a policy of `environment: {type: grasp}` has first actions to judge")
    position, yaw = report["position_error_m"], report["yaw_error_deg"]
    return [
        fault.text,
        f"{report['first_action_success']:.1%}",
        f"{position['median'] * 1000.0:.1f} / {position['p95'] * 1000.0:.1f}",
        f"{yaw['median']:.2f} / {yaw['p95']:.2f}",
    ]


if __name__ == "__main__":
    raise SystemExit(main())
