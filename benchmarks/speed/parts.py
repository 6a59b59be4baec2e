"""The parts of `python -m benchmarks.speed`: each measures, and returns a table."""

from __future__ import annotations

import argparse
from functools import partial

from rich.progress import track
from rich.table import Table

from benchmarks.command import missing
from benchmarks.speed.figures import MODES, Figures, growth, speedup
from benchmarks.speed.limits import table_of_limits
from benchmarks.speed.processes import peak_mib, start_s
from benchmarks.speed.ranks import OfRanks
from benchmarks.speed.runs import table_of_runs
from benchmarks.speed.simulation import FRAMES, frames, steps
from benchmarks.speed.training import PEER_PACKAGES, Ventosa, contenders, training
from benchmarks.tables import table


def simulator(options: argparse.Namespace) -> Table:
    """Pictures per second of both simulators."""
    found: Figures = {}
    for size in track(options.sizes, "simulators", transient=True):
        for kind in FRAMES:
            found |= frames(kind, size, options.num_envs, options.repeats, options.seconds)
    return comparison("simulators", found)


def environment(options: argparse.Namespace) -> Table:
    """Steps per second of a quarter of N, N, and four times N environments."""
    found: Figures = {}
    counts = (options.num_envs // 4, options.num_envs, 4 * options.num_envs)
    for size in track(options.sizes, "environments", transient=True):
        for mode in MODES:
            found |= steps(mode, size, counts, options.repeats, options.seconds)
    grows = [f"N^{power:.2f} ({_image(s)}, {mode})" for (s, mode), power in growth(found).items()]
    caption = f"the time of a step of all N grows as {', '.join(grows)}"
    return comparison("environments, random actions", found, caption)


def train(options: argparse.Namespace) -> Table:
    """Steps per second of the training loops."""
    found: Figures = {}
    sizes: dict[str, int] = {}
    ours = Ventosa if options.ranks == 1 else partial(OfRanks, options.ranks)
    makers = contenders(not missing(*PEER_PACKAGES), ours)
    for size in track(options.sizes, "training", transient=True):
        for mode in MODES:
            figures, sizes[_image(size)] = training(
                mode, size, options.num_envs, options.repeats, options.seconds, makers
            )
            found |= figures
    counts = ", ".join(f"{image}: {n:,}" for image, n in sizes.items())
    return comparison("PPO on the same environment", found, f"parameters of each network: {counts}")


def memory(options: argparse.Namespace) -> Table:
    """Peak memory of the contenders, and the time to the first step."""
    names = list(contenders(peer=not missing(*PEER_PACKAGES)))
    rows = [
        (
            mode,
            _image(size),
            *(f"{peak_mib(name, size, mode, options.num_envs):,.0f}" for name in names),
        )
        for size in track(options.sizes, "memory", transient=True)
        for mode in MODES
    ]
    return table(
        "peak resident memory of a training process, MiB",
        ("mode", "image", *names),
        rows,
        f"from the start of `trainers.learn` to its first step, compiled: {start_s():.1f} s",
    )


def runs(options: argparse.Namespace) -> Table:
    """Steps per second of the project's own run files, and where their time goes."""
    return table_of_runs(options.device, options.seconds)


def limits(options: argparse.Namespace) -> Table:
    """Times of the simulator's pieces and of updates, beside what the machine can do."""
    return table_of_limits(options.seconds)


PARTS = {
    "simulator": simulator,
    "environment": environment,
    "training": train,
    "memory": memory,
    "runs": runs,
    "limits": limits,
}


def comparison(title: str, figures: Figures, caption: str = "") -> Table:
    """What the contenders reached in each case: median (smallest to largest)."""
    names = list(dict.fromkeys(name for found in figures.values() for name in found))
    rows = []
    for case, found in figures.items():
        cells = [str(samples or "") for samples in (*map(found.get, names), speedup(found))]
        rows.append([case.what, case.mode, _image(case.size), str(case.num_envs), *cells])
    head = ("per second", "mode", "image", "N", *names, "times as fast")
    return table(title, head, rows, caption, left=2)


def _image(size: int) -> str:
    return f"{size}x{size}"
