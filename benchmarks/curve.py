"""Prints learning curves from TensorBoard's files: `python -m benchmarks.curve results/run`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

TAGS = {
    "lesson": "Environment/Lesson Number/lesson",
    "success": "Environment/Success Rate",
    "reward": "Environment/Cumulative Reward",
    "position error (m)": "Environment/Position Error M",
    "yaw error (deg)": "Environment/Yaw Error Deg",
    "steps/s": "Performance/Steps Per Second",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints one row for every so many minutes, and the last one before the end."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.curve", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="folders of runs")
    parser.add_argument("--every", type=float, default=5.0, metavar="MINUTES")
    parser.add_argument("--until", type=float, default=30.0, metavar="MINUTES")
    options = parser.parse_args(arguments)
    for run in options.runs:
        Console().print(curve(run, options.every, options.until))
    return 0


def curve(run: Path, every_min: float, until_min: float) -> Table:
    """The curve of one run against the time since its run file was written."""
    events = EventAccumulator(str(run)).Reload()
    begun = (run / "configuration.yaml").stat().st_mtime
    known = {name: tag for name, tag in TAGS.items() if tag in events.Tags()["scalars"]}
    points = {
        name: {event.step: event for event in events.Scalars(tag)} for name, tag in known.items()
    }
    table = Table(title=str(run))
    for column in ("minutes", "step", *known):
        table.add_column(column, justify="right")
    latest: dict[int, int] = {}
    for step, event in points["reward"].items():
        minutes = (event.wall_time - begun) / 60.0
        if minutes <= until_min:
            latest[int(minutes // every_min)] = step
    for step in latest.values():
        minutes = (points["reward"][step].wall_time - begun) / 60.0
        values = [points[name].get(step) for name in known]
        cells = ["" if event is None else f"{event.value:.3g}" for event in values]
        table.add_row(f"{minutes:.1f}", f"{step:,}", *cells)
    return table


if __name__ == "__main__":
    raise SystemExit(main())
