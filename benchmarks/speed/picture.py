"""The figures as a picture. Needs the extra `bench`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FuncFormatter, NullLocator

from benchmarks.speed.figures import FAST, OURS, PEER, PYBULLET, Figure

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
    sizes = sorted({figure.case.size for line in lines.values() for figure in line})
    for name, line in lines.items():
        x = [figure.case.size for figure in line]
        middle = [figure.samples.median for figure in line]
        low = [figure.samples.low for figure in line]
        high = [figure.samples.high for figure in line]
        axes.plot(x, middle, marker="o", markersize=4, color=COLORS[name])
        axes.fill_between(x, low, high, color=COLORS[name], alpha=0.2, linewidth=0)
        for across, up in zip(x, middle, strict=True):
            axes.annotate(
                _short(up, None),
                (across, up),
                xytext=(0, 5),
                textcoords="offset points",
                ha="center",
                fontsize=7,
                color=COLORS[name],
            )
        axes.annotate(
            name,
            (x[-1], middle[-1]),
            xytext=(12, 0),
            textcoords="offset points",
            va="center",
            weight="bold",
            color=COLORS[name],
        )
    axes.set(title=title, xscale="log", yscale="log", xlabel="side of the images, pixels")
    axes.set_xlim(sizes[0] / 1.15, sizes[-1] * ROOM_FOR_LABELS)
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(_short))
    axes.yaxis.set_minor_locator(NullLocator())


def _short(value: float, _: object) -> str:
    """`870`, `1.2k`, `45k`."""
    if value < 1e3:
        return f"{value:.0f}"
    return f"{value / 1e3:.1f}k" if value < 1e4 else f"{value / 1e3:.0f}k"
