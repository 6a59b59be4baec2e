"""What ranks cost each other: the same work a rank on 1, 2, 4 and 8 of torchrun's processes.

    python -m benchmarks.ranks [benchmarks/ranks/stream.yaml] [--page docs/scale.md]

Each rank has one thread, and of frame_grab.yaml beside this file, or of another run file of PPO,
64 environments and 256 transitions of a minibatch, so that k ranks do k times what one does. In
turn with updates that they make together, they make each its own, and tell each other nothing: what
they cost each other by sharing a machine. A model of an update's time is fitted to it, and says
what more ranks would take.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.command import ROOT, torchrun
from benchmarks.ranks.model import Measured, Model, Network
from benchmarks.tables import table, write_between
from trainers.common.command import tells_failures
from trainers.common.cores import usable_cores
from trainers.comparison.tables import markdown

RUN_FILE = Path(__file__).parent / "frame_grab.yaml"
COUNTS = (1, 2, 4, 8)
PREDICTED = (64, 1_024)
NETWORKS = (
    Network("10 Gbit/s, 50 us", 50e-6, 1.25e9),
    Network("100 Gbit/s, 10 us", 10e-6, 12.5e9),
)
ROWS = (
    *("all of it", "as the model has it", "efficiency", "of apart"),
    *("collection", "learning", "sums", "gathers", "waiting", "a sum"),
)
"""Of the table, in milliseconds of an update where they are times."""


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, fits, predicts, and prints it all."""
    options = parse(arguments)
    measured = measure(options.run_file, options.counts, options.rounds, options.updates)
    model = Model.fit(measured, usable_cores())
    head = ["ms an update, of ranks", *(str(ranks) for ranks in measured)]
    columns = [column(ranks, measured, model) for ranks in measured]
    rows = list(zip(ROWS, *columns, strict=True))
    lines = [*told(measured, model), ""]
    ahead = predictions(model)
    console = Console()
    console.print(table("the same work a rank", head, rows), *lines, sep="\n")
    console.print(table("as the model has it", *ahead))
    if options.page is not None:
        write_between(options.page, "ranks", [*markdown(head, rows), "", *lines, *markdown(*ahead)])
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ranks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_file", type=Path, nargs="?", default=RUN_FILE)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="of ranks")
    parser.add_argument("--rounds", type=int, default=2, help="of all counts, in turn")
    parser.add_argument("--updates", type=int, default=4, help="of a round, apart and together")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the tables as Markdown")
    options = parser.parse_args(arguments)
    if 1 not in options.counts or max(options.counts) == 1:
        parser.error("--counts: one rank, and several, are what is compared")
    return options


def measure(
    run_file: Path, counts: Sequence[int], rounds: int, updates: int
) -> dict[int, Measured]:
    """Starts the processes of each count in turn, so that what else happens meets all alike."""
    with tempfile.TemporaryDirectory() as folder:
        paths = {k: [Path(folder, f"{k}-{turn}.json") for turn in range(rounds)] for k in counts}
        for turn in range(rounds):
            for count in counts:
                start(run_file, count, paths[count][turn], updates)
        return {count: Measured.read(paths[count]) for count in counts}


def start(run_file: Path, count: int, path: Path, updates: int) -> None:
    """Has so many ranks measure, each with one thread, and write it to a file."""
    rank = ("benchmarks.ranks.rank", str(path), str(run_file.resolve()), str(updates))
    subprocess.run(
        torchrun(count, *rank),
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        check=True,
    )


def column(ranks: int, measured: Mapping[int, Measured], model: Model) -> list[str]:
    """`ROWS` of so many ranks."""
    found, one = measured[ranks], measured[1]
    turns = max(1.0, ranks / model.cores)
    parts = (found.collection_s, found.learning_s, found.sums_s, found.gathers_s, found.waiting_s)
    return [
        f"{1e3 * found.together_s:.0f}",
        f"{1e3 * model.update_s(ranks, model.cores):.0f}",
        f"{turns * one.together_s / found.together_s:.0%}",
        f"{found.apart_s / found.together_s:.0%}",
        *(f"{1e3 * part:.0f}" for part in parts),
        f"{1e3 * found.sums_s / found.sums:.2f}" if found.sums else "",
    ]


def told(measured: Mapping[int, Measured], model: Model) -> list[str]:
    """Sentences about the parameters of the model, and about checkpoints."""
    checkpoints = ", ".join(
        f"{found.checkpoint_bytes / 1e6:.1f} MB and {1e3 * found.checkpoint_s:.0f} ms of {ranks}"
        for ranks, found in measured.items()
    )
    return [
        f"{model.cores} cores. A sum of {model.gradient_bytes / 1e6:.1f} MB, {model.sums:.0f} an "
        f"update: {1e3 * model.latency_s:.2f} ms and {model.bytes_per_s / 1e9:.1f} GB/s. What a "
        f"rank takes between two sums deviates by {model.deviation:.1%} of it.",
        f"Gathering a checkpoint: {checkpoints}.",
    ]


def predictions(model: Model) -> tuple[list[str], list[list[str]]]:
    """Head and rows of efficiencies where each rank has a core."""
    head = ["ranks, a core each", "one machine", *(network.name for network in NETWORKS)]
    rows = [
        [
            f"{ranks:,}",
            *(f"{model.efficiency(ranks, network):.0%}" for network in (None, *NETWORKS)),
        ]
        for ranks in PREDICTED
    ]
    return head, rows


if __name__ == "__main__":
    raise SystemExit(main())
