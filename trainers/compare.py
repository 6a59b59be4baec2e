"""The command line: `python -m trainers.compare config/paper --seeds 3`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from trainers.common.command import DONE, FAILED, require_extra, tells_failures
from trainers.common.errors import UserError
from trainers.common.options import add_results_option, command_parser, positive
from trainers.comparison.jobs import CORES, run_missing
from trainers.learn import stop_on_signals


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Runs what is missing and reports on all; returns the exit code."""
    options = parse_options(arguments)
    require_extra("render", "matplotlib")
    # Imported late, so that `--help` answers at once.
    from trainers.comparison.planning import collect, jobs_of, plan, runs_in  # noqa: PLC0415
    from trainers.comparison.report import write_report  # noqa: PLC0415
    from trainers.runfile.registry import load_registries  # noqa: PLC0415

    made = {path: runs for path in options.paths if (runs := runs_in(path))}
    planned = list(plan(options, [path for path in options.paths if path not in made]))
    registries = load_registries()
    # All run files are looked at before the first run begins.
    jobs = jobs_of(planned, registries)
    with stop_on_signals() as stop:
        try:
            code = run_missing(jobs, options.jobs, stop.requested)
            experiments = collect(planned, [run for runs in made.values() for run in runs])
            page = write_report(experiments, options.report or options.results_dir)
        except OSError as error:
            raise UserError(f"{error.filename}: can't be written: {error.strerror}") from error
    print(page)
    for run in (run for runs in experiments.values() for run in runs if run.is_unreadable):
        print(run.status["reason"], file=sys.stderr)
        code = FAILED
    if stop.requested():
        return stop.exit_code
    return FAILED if code else DONE


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = command_parser(
        "compare",
        description="Run experiments with several seeds each, and put them side by side.",
    )
    parser.add_argument(
        "paths",
        nargs="+",
        type=Path,
        metavar="CONFIG_OR_FOLDER",
        help="run files, folders of them, or runs made elsewhere and folders of those",
    )
    parser.add_argument("--seeds", type=positive, default=3, help="runs of each run file")
    parser.add_argument("--max-steps", type=positive, help="overrides trainer.max_steps")
    parser.add_argument("--device", help="overrides `device`, such as cpu or cuda")
    parser.add_argument("--jobs", type=positive, default=CORES, help="runs at a time")
    parser.add_argument("--report", type=Path, metavar="FOLDER", help="default: with the runs")
    add_results_option(parser, "results/compare")
    return parser.parse_intermixed_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
