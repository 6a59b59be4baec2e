"""The figures for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.table import Table

from benchmarks.speed.figures import Figure, Growth, by_case, speedup
from benchmarks.speed.processes import Footprint
from benchmarks.speed.timing import Samples

MS_PER_S = 1e3


def comparison(title: str, figures: Sequence[Figure], caption: str = "") -> Table:
    """What the contenders reached in each case, a second: median (smallest to largest)."""
    names = list(dict.fromkeys(figure.contender for figure in figures))
    table = _table(title, ("per second", "mode", "image", "N"), (*names, "times as fast"))
    table.caption = caption
    for case, found in by_case(figures).items():
        ratio = speedup(found)
        table.add_row(
            case.what,
            case.mode,
            _image(case.size),
            str(case.num_envs),
            *(_spread(found[name].samples) if name in found else "" for name in names),
            "" if ratio is None else _spread(ratio),
        )
    return table


def growth_table(grown: Iterable[Growth]) -> Table:
    """How the time of a step grows with the number of environments."""
    table = _table(
        "time of a step of all N environments, simulator fast",
        ("mode", "image"),
        ("milliseconds by N", "grows as"),
    )
    for one in grown:
        times = ", ".join(f"{n}: {MS_PER_S * s:.3g}" for n, s in one.step_s.items())
        table.add_row(one.mode, _image(one.size), times, f"N^{one.exponent:.2f}")
    return table


def memory_table(footprints: Sequence[Footprint], start_s: float) -> Table:
    """Peak memory of the contenders, and the time to the first step."""
    names = list(dict.fromkeys(one.contender for one in footprints))
    cells: dict[tuple[str, int], dict[str, float]] = {}
    for one in footprints:
        cells.setdefault((one.mode, one.size), {})[one.contender] = one.peak_mib
    table = _table("peak resident memory of a training process, MiB", ("mode", "image"), names)
    for (mode, size), found in cells.items():
        table.add_row(mode, _image(size), *(f"{found[name]:,.0f}" for name in names))
    table.caption = (
        f"from the start of `trainers.learn` to its first step, compiled: {start_s:.1f} s"
    )
    return table


def _table(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(title=title)
    for column in left:
        table.add_column(column)
    for column in right:
        table.add_column(column, justify="right")
    return table


def _image(size: int) -> str:
    return f"{size}x{size}"


def _spread(samples: Samples) -> str:
    values = (samples.median, samples.low, samples.high)
    median, low, high = (f"{v:,.0f}" if samples.median >= 100 else f"{v:.2f}" for v in values)
    return f"{median} ({low} to {high})"
