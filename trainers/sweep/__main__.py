"""The command line: `python -m trainers.sweep config/sweeps/cartpole.yaml`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from trainers.common.command import DONE, FAILED, require_extra, tells_failures
from trainers.common.errors import UserError
from trainers.common.options import command_parser, positive
from trainers.comparison.jobs import CORES
from trainers.learn import Stop, stop_on_signals

JOURNAL = "study.journal"


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the trials that are missing and reports on all; returns the exit code."""
    options = parse_options(arguments)
    require_extra("sweep", "optuna", "matplotlib")
    try:
        with stop_on_signals() as stop:
            return _sweep(options, stop)
    except OSError as error:
        raise UserError(f"{error.filename}: can't be written: {error.strerror}") from error


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = command_parser(
        "sweep",
        description="Try settings of a run file, and report on which did best.",
    )
    parser.add_argument("sweep", type=Path, metavar="SWEEP", help="the sweep file")
    parser.add_argument(
        "--storage",
        metavar="URL_OR_FILE",
        help="shared by the sweep's processes: a database's URL, or a journal file "
        f"(default: {JOURNAL}, with the runs)",
    )
    parser.add_argument("--trials", type=positive, help="of the whole sweep; overrides `trials`")
    parser.add_argument("--jobs", type=positive, default=CORES, help="trials at a time")
    parser.add_argument(
        "--results-dir", type=Path, default=Path("results/sweeps"), help="where sweeps are kept"
    )
    return parser.parse_args(arguments)


def _sweep(options: argparse.Namespace, stop: Stop) -> int:
    """Sweeps; imports late, what is of the extra `sweep` and what takes seconds."""
    from trainers.runfile.registry import load_registries  # noqa: PLC0415
    from trainers.sweep.plan import load_sweep  # noqa: PLC0415
    from trainers.sweep.report import finished, write_report  # noqa: PLC0415
    from trainers.sweep.study import STORAGE_ERRORS, open_study, storage_failure  # noqa: PLC0415
    from trainers.sweep.trials import Trials  # noqa: PLC0415

    registries = load_registries()
    sweep = load_sweep(options.sweep, registries)
    folder = options.results_dir / sweep.name
    storage = options.storage or str(folder / JOURNAL)
    study = open_study(sweep, storage)
    try:
        trials = Trials(sweep, study, folder, registries, stop.requested)
        trials.run(sweep.count(options.trials), options.jobs)
        page = write_report(sweep, study, folder, registries)
        code = DONE if finished(study) else FAILED
    except STORAGE_ERRORS as error:
        raise storage_failure(storage, error) from error
    print(page)
    return stop.exit_code if stop.requested() else code


if __name__ == "__main__":
    sys.exit(main())
