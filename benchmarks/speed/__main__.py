"""How fast everything is, side by side with its peers: `python -m benchmarks.speed`.

Simulators and environments are compared with PyBullet's, the training loop with Stable-Baselines3's
PPO on the same environment. All are measured in turn in one run: the median over the rounds counts,
and the slowest and the fastest round are shown beside it. All of it takes about an hour, most of
which is training on the largest images; `--sizes 80` takes minutes.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from benchmarks.speed.report import Report

PARTS = ("simulator", "environment", "training", "memory")
SIZES = (32, 80, 128, 256)
PEER_PACKAGE = "stable_baselines3"
INSTALL = "pip install -c constraints.txt -e '.[bench]'"
MISTAKE = 2
# A batch is 512 transitions, and there are 32 of each environment in a buffer.
MIN_TRAIN_ENVS = 16


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints tables, and writes picture and JSON where asked."""
    options = parse(arguments)
    console = Console()
    if options.picture is not None and not installed("matplotlib"):
        print(f"error: --picture needs matplotlib; install it with: {INSTALL}", file=sys.stderr)
        return MISTAKE
    if not installed(PEER_PACKAGE) and {"training", "memory"} & set(options.parts):
        console.print(
            "stable-baselines3 is not installed, so training is measured without it; "
            f"to compare: {INSTALL}",
            markup=False,
        )
    # As `trainers.learn` has it, and before torch is imported: idle threads wait, and don't spin.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from benchmarks.speed.report import Report, machine  # noqa: PLC0415

    report = Report(machine())
    for part in options.parts:
        MEASURES[part](options, report, console)
        if options.json is not None:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(report.plain(), indent=2) + "\n")
    if options.picture is not None and report.figures:
        from benchmarks.speed.picture import draw  # noqa: PLC0415

        draw(report.figures, options.picture)
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument(
        "--sizes", type=int, nargs="+", choices=SIZES, default=SIZES, help="image sides in pixels"
    )
    parser.add_argument(
        "--num-envs",
        type=int,
        nargs="+",
        default=(64, 256, 1024),
        metavar="N",
        help="environments of `simulator: fast`; PyBullet has the first number",
    )
    parser.add_argument("--num-worlds", type=int, default=256, metavar="N", help="of a simulator")
    parser.add_argument(
        "--train-envs", type=int, default=256, metavar="N", help="environments to train on"
    )
    parser.add_argument("--repeats", type=int, default=3, help="rounds, of which the median counts")
    parser.add_argument("--seconds", type=float, default=2.0, help="of a measurement, at least")
    parser.add_argument(
        "--quick", action="store_true", help="two small sizes and three short rounds, unless given"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw them (.png, .svg, .pdf)")
    if "--quick" in (sys.argv[1:] if arguments is None else arguments):
        parser.set_defaults(sizes=(32, 80), num_envs=(64, 256), repeats=3, seconds=0.5)
    options = parser.parse_args(arguments)
    for name, least in (("num_worlds", 1), ("repeats", 1), ("train_envs", MIN_TRAIN_ENVS)):
        if getattr(options, name) < least:
            parser.error(f"--{name.replace('_', '-')} must be at least {least}")
    if min(options.num_envs) < 1:
        parser.error("--num-envs must be at least 1")
    return options


def installed(module: str) -> bool:
    """Whether a package of the extra `bench` is there."""
    return importlib.util.find_spec(module) is not None


# Each part imports what it needs when its turn comes, so that the others run without it.


def _simulator(options: argparse.Namespace, report: Report, console: Console) -> None:
    from benchmarks.speed.simulators import measure  # noqa: PLC0415
    from benchmarks.speed.tables import comparison  # noqa: PLC0415

    figures = []
    for size in _announced("simulators", options.sizes, console):
        figures += measure(size, options.num_worlds, options.repeats, options.seconds)
    report.figures += figures
    console.print(comparison(f"simulators, {_cores(report)}", figures))


def _environment(options: argparse.Namespace, report: Report, console: Console) -> None:
    from benchmarks.speed.environments import measure  # noqa: PLC0415
    from benchmarks.speed.figures import FAST, growth  # noqa: PLC0415
    from benchmarks.speed.tables import comparison, growth_table  # noqa: PLC0415

    figures = []
    for size in _announced("environments", options.sizes, console):
        figures += measure(size, options.num_envs, options.repeats, options.seconds)
    report.figures += figures
    report.growth = growth([figure for figure in figures if figure.contender == FAST])
    console.print(comparison(f"environments, random actions, {_cores(report)}", figures))
    if report.growth:
        console.print(growth_table(report.growth))


def _training(options: argparse.Namespace, report: Report, console: Console) -> None:
    from benchmarks.speed.setup import Setup  # noqa: PLC0415
    from benchmarks.speed.tables import comparison  # noqa: PLC0415
    from benchmarks.speed.training import contenders, measure  # noqa: PLC0415

    figures = []
    for size in _announced("training", options.sizes, console):
        setup = Setup(size=size, num_envs=options.train_envs)
        found, report.parameters[size] = measure(
            setup, options.repeats, options.seconds, contenders(installed(PEER_PACKAGE))
        )
        figures += found
    report.figures += figures
    title = f"PPO on the same environment, {_cores(report)}, {_threads(report)}"
    counts = ", ".join(f"{size}x{size}: {n:,}" for size, n in report.parameters.items())
    console.print(comparison(title, figures, f"parameters of each network: {counts}"))


def _memory(options: argparse.Namespace, report: Report, console: Console) -> None:
    from benchmarks.speed.figures import OURS, PEER  # noqa: PLC0415
    from benchmarks.speed.processes import footprints, start_s  # noqa: PLC0415
    from benchmarks.speed.setup import Setup  # noqa: PLC0415
    from benchmarks.speed.tables import memory_table  # noqa: PLC0415

    names = [OURS, PEER] if installed(PEER_PACKAGE) else [OURS]
    for size in _announced("memory", options.sizes, console):
        report.memory += footprints(Setup(size=size, num_envs=options.train_envs), names)
    report.start_s = start_s()
    console.print(memory_table(report.memory, report.start_s))


MEASURES = {
    "simulator": _simulator,
    "environment": _environment,
    "training": _training,
    "memory": _memory,
}


def _announced(what: str, sizes: Sequence[int], console: Console) -> Iterator[int]:
    """The sizes, each shown on a terminal while it is measured."""
    with console.status("") as status:
        for size in sizes:
            status.update(f"measuring {what} at {size}x{size}")
            yield size


def _threads(report: Report) -> str:
    return f"{report.machine['torch_threads']} torch threads"


def _cores(report: Report) -> str:
    return f"{report.machine['cores']} cores"


if __name__ == "__main__":
    raise SystemExit(main())
