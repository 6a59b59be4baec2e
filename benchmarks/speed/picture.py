"""The figures as a picture. Needs the extra `bench`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from benchmarks.speed.figures import FAST, OURS, PEER, PYBULLET, Figure
from trainers.reporting.terminal import format_count

COLORS = {OURS: "#0b6e4f", FAST: "#0b6e4f", PEER: "#c8553d", PYBULLET: "#c8553d"}
LEFT_OUT = ("collection steps", "update steps")
"""In the tables only: the whole loop shows them."""

PANEL_INCHES = (4.4, 3.3)
COLUMNS = 3
ROOM_FOR_LABELS = 1.9
STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
}


def draw(figures: Iterable[Figure], path: Path) -> None:
    """Draws how fast everyone is against the size of the images, a panel for each quantity."""
    panels = _panels(figures)
    columns = min(len(panels), COLUMNS)
    rows = -(-len(panels) // COLUMNS)
    width, height = PANEL_INCHES
    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(columns * width, rows * height), layout="constrained")
        for number, (title, lines) in enumerate(panels.items(), start=1):
            _panel(canvas.add_subplot(rows, columns, number), title, lines)
        path.parent.mkdir(parents=True, exist_ok=True)
        canvas.savefig(path, dpi=150)


def _panels(figures: Iterable[Figure]) -> dict[str, dict[str, list[Figure]]]:
    """By its title what each panel shows: the contenders' lines, with the first N measured."""
    panels: dict[str, dict[str, list[Figure]]] = {}
    first: dict[str, int] = {}
    for figure in figures:
        case = figure.case
        if case.what in LEFT_OUT:
            continue
        title = f"{case.what} per second" + (f", {case.mode}" if case.mode else "")
        if case.num_envs == first.setdefault(title, case.num_envs):
            lines = panels.setdefault(title, {})
            lines.setdefault(figure.contender, []).append(figure)
    return panels


def _panel(axes: Any, title: str, lines: dict[str, list[Figure]]) -> None:
    fastest_first = sorted(lines, key=lambda name: -lines[name][-1].samples.median)
    for place, name in enumerate(fastest_first):
        _line(axes, name, lines[name], above=place == 0)
    sizes = sorted({figure.case.size for line in lines.values() for figure in line})
    axes.set(title=title, xscale="log", yscale="log", xlabel="side of the images, pixels")
    axes.set_xlim(sizes[0] / 1.15, sizes[-1] * ROOM_FOR_LABELS)
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.margins(y=0.15)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: format_count(value)))
    axes.yaxis.set_minor_locator(NullLocator())


def _line(axes: Any, name: str, line: list[Figure], *, above: bool) -> None:
    """One contender: medians, the range of all rounds behind them, and its name at the end."""
    color, x = COLORS[name], [figure.case.size for figure in line]
    samples = [figure.samples for figure in line]
    axes.plot(x, [one.median for one in samples], marker="o", markersize=4, color=color)
    low, high = [one.low for one in samples], [one.high for one in samples]
    axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    for across, one in zip(x, samples, strict=True):
        label = {"xytext": (0, 5 if above else -12), "ha": "center", "fontsize": 7}
        _note(axes, format_count(one.median), (across, one.median), color=color, **label)
    _note(
        axes,
        name,
        (x[-1], samples[-1].median),
        color=color,
        xytext=(12, 0),
        va="center",
        weight="bold",
    )


def _note(axes: Any, text: str, place: tuple[float, float], **style: Any) -> None:
    axes.annotate(text, place, textcoords="offset points", **style)
