"""How near the simulator and the updates come to what the machine can do: a roofline in a table.

Williams, Waterman and Patterson, "Roofline: an insightful visual performance model for multicore
architectures", 2009: a loop takes no less time than its arithmetic at the machine's peak, and no
less than its memory at the machine's bandwidth.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing

from rich.progress import track
from rich.table import Table

from benchmarks.speed.figures import rate
from benchmarks.speed.machine import Machine, machine, threads_for
from benchmarks.speed.pieces import Pieces, Work, pieces
from benchmarks.tables import table
from trainers.common.cores import usable_cores

HEAD = ("piece", "item", "us", "all cores", "kop", "kB", "of the limit")
KILO, GIGA = 1e3, 1e9
ARITHMETIC, MEMORY = "arithmetic", "memory"


def table_of_limits(seconds: float, wanted: Pieces | None = None) -> Table:
    """Times of one core beside its limits, and how many times as fast all cores are.

    Args:
        seconds: of each measurement, at least.
        wanted: the pieces; None: all.
    """
    cores = usable_cores()
    one, every = machine(1, seconds), machine(cores, seconds)
    rows = [
        [*name, *row(ready, one, cores, seconds)]
        for name, ready in track((wanted or pieces()).items(), "limits", transient=True)
    ]
    caption = f"at most: one core {shown(one)}; {cores} cores {shown(every)}"
    return table("limits", HEAD, rows, caption, left=2)


def shown(limits: Machine) -> str:
    """What some cores can do, in words."""
    return (
        f"{limits.operations / GIGA:.0f} Gop/s, {limits.product_operations / GIGA:.0f} in torch's "
        f"products of matrices, {limits.bytes / GIGA:.0f} GB/s"
    )


def row(ready: Callable[[], Work], one: Machine, cores: int, seconds: float) -> list[str]:
    """Measures a piece; cells from `us` on."""
    item_s, work = _timed(ready, 1, seconds, time.thread_time)
    every_s, _ = _timed(ready, cores, seconds, time.perf_counter)
    share, bound = limit(work, item_s, one)
    return [
        f"{1e6 * item_s:,.1f}",
        f"{item_s / every_s:.2f}",
        f"{work.operations / KILO:,.0f}",
        f"{work.bytes / KILO:,.0f}",
        f"{100.0 * share:.0f} % of {bound}",
    ]


def limit(work: Work, item_s: float, most: Machine) -> tuple[float, str]:
    """The share of the time that an item would take at the machine's limit, and which limit it is.

    Args:
        work: what an item is.
        item_s: the time it takes.
        most: what the machine can do in that time.
    """
    least_s = {ARITHMETIC: work.operations / most.operations, MEMORY: work.bytes / most.bytes}
    bound = max(least_s, key=lambda name: least_s[name])
    return least_s[bound] / item_s, bound


def _timed(
    ready: Callable[[], Work], cores: int, seconds: float, clock: Callable[[], float]
) -> tuple[float, Work]:
    """Seconds of an item on so many cores, by a clock, and what it was."""
    with threads_for(cores):
        work = ready()
        with closing(work):
            rate(work.do, 0.0, work.prepare)  # compiles
            return 1.0 / rate(work.do, seconds, work.prepare, clock), work
