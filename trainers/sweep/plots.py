"""Figures of a sweep: heat maps of pairs of settings, and parallel coordinates."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainers.sweep.plan import Range, Value

CELLS = 5
"""Of a range in a heat map."""
COLUMNS = 3
COLORS = "viridis"


@dataclass(frozen=True)
class Scored:
    """A trial's values by the settings' keys, and its score."""

    values: Mapping[str, Value]
    score: float


@dataclass(frozen=True)
class Scale:
    """A setting as an axis from 0 to 1, in cells of one width."""

    label: str
    axis: Range

    @property
    def cells(self) -> int:
        """Their number: a choice has one for each value."""
        return CELLS if self.axis.choice is None else len(self.axis.choice)

    def position(self, value: Any) -> float:
        """Where a value is; in a choice the middle of its cell."""
        if self.axis.choice is not None:
            return (self.axis.choice.index(value) + 0.5) / self.cells
        low, high = map(self._linear, self.axis.ends)
        return (self._linear(value) - low) / (high - low)

    def cell(self, value: Any) -> int:
        """The cell that a value is in."""
        return min(int(self.position(value) * self.cells), self.cells - 1)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Positions and labels: of a choice its values, of a range the edges of its cells."""
        if self.axis.choice is not None:
            return [(self.position(value), str(value)) for value in self.axis.choice]
        low, high = map(self._linear, self.axis.ends)
        places = np.linspace(0.0, 1.0, self.cells + 1).tolist()
        return [(place, self._text(low + place * (high - low))) for place in places]

    def _linear(self, value: float) -> float:
        return math.log(value) if self.axis.log else float(value)

    def _text(self, linear: float) -> str:
        return f"{math.exp(linear) if self.axis.log else linear:.2g}"


def scales_of(space: Mapping[str, Range]) -> dict[str, Scale]:
    """Axes of a space's settings, by their keys."""
    names = labels(list(space))
    return {key: Scale(names[key], axis) for key, axis in space.items()}


def labels(keys: Sequence[str]) -> dict[str, str]:
    """Keys by their last parts, as many as tell them apart."""
    short: dict[str, str] = {}
    for key in keys:
        parts = key.split(".")
        ends = (".".join(parts[-count:]) for count in range(1, len(parts) + 1))
        short[key] = next(
            end
            for end in ends
            if end == key or sum(f".{other}".endswith(f".{end}") for other in keys) == 1
        )
    return short


def cell_means(x: Scale, y: Scale, places: Sequence[tuple[Any, Any, float]]) -> NDArray[np.float64]:
    """Mean scores (cells of y, cells of x) of trials at values of x and y; NaN where none is."""
    total, count = np.zeros((y.cells, x.cells)), np.zeros((y.cells, x.cells))
    for x_value, y_value, score in places:
        cell = y.cell(y_value), x.cell(x_value)
        total[cell] += score
        count[cell] += 1
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def draw_heat_maps(
    space: Mapping[str, Range], trials: Sequence[Scored], files: Sequence[Path]
) -> None:
    """Draws a map for each pair of settings: the mean score of the trials in each cell.

    Args:
        space: at least two settings.
        trials: at least one.
        files: to write.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  # of the extra `render`

    scales = scales_of(space)
    pairs = list(itertools.combinations(space, 2))
    columns = min(COLUMNS, len(pairs))
    rows = -(-len(pairs) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.6 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    means = {}
    for x, y in pairs:
        places = [(trial.values[x], trial.values[y], trial.score) for trial in trials]
        means[x, y] = cell_means(scales[x], scales[y], places)
    low = min(np.nanmin(mean) for mean in means.values())
    high = max(np.nanmax(mean) for mean in means.values())
    for axis, ((x, y), mean) in zip(axes, means.items(), strict=False):
        image = axis.imshow(
            mean, COLORS, origin="lower", extent=(0, 1, 0, 1), aspect="auto", vmin=low, vmax=high
        )
        _write_in_cells(axis, mean, (low + high) / 2)
        axis.set_xticks(*_ticks(scales[x]))
        axis.set_yticks(*_ticks(scales[y]))
        axis.tick_params(labelsize=8)
        axis.set(xlabel=scales[x].label, ylabel=scales[y].label)
    for axis in axes[len(pairs) :]:
        axis.set_axis_off()
    figure.colorbar(image, ax=axes, label="score")
    for file in files:
        figure.savefig(file, dpi=110)


def _write_in_cells(axis: Any, mean: NDArray[np.float64], middle: float) -> None:
    rows, columns = mean.shape
    for (row, column), value in np.ndenumerate(mean):
        if not np.isnan(value):
            place = (column + 0.5) / columns, (row + 0.5) / rows
            color = "black" if value > middle else "white"
            axis.text(*place, f"{value:.3g}", color=color, ha="center", va="center", fontsize=8)


def _ticks(scale: Scale) -> tuple[list[float], list[str]]:
    places, texts = zip(*scale.ticks, strict=True)
    return list(places), list(texts)


def draw_parallel(
    space: Mapping[str, Range], trials: Sequence[Scored], files: Sequence[Path]
) -> None:
    """Draws each trial as a line across the settings' axes, colored by its score.

    Args:
        space: the settings.
        trials: at least one; those that did best are drawn last.
        files: to write.
    """
    from matplotlib import colormaps  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    scales = scales_of(space)
    scores = [trial.score for trial in trials]
    low, span = min(scores), (max(scores) - min(scores)) or 1.0
    figure = Figure(figsize=(2.2 * (len(space) + 1), 4.0), layout="constrained")
    axis = figure.subplots()
    for trial in sorted(trials, key=lambda trial: trial.score):
        share = (trial.score - low) / span
        line = [scale.position(trial.values[key]) for key, scale in scales.items()]
        axis.plot([*line, share], color=colormaps[COLORS](share), alpha=0.4 + 0.6 * share)
    ends = [(0.0, f"{low:.4g}"), (1.0, f"{low + span:.4g}")]
    for x, ticks in enumerate([*(scale.ticks for scale in scales.values()), ends]):
        axis.axvline(x, color="black", linewidth=0.8)
        for place, text in ticks:
            axis.text(x - 0.03, place, text, ha="right", va="center", fontsize=8)
    axis.set_xticks(range(len(space) + 1), [*(scale.label for scale in scales.values()), "score"])
    axis.set_yticks([])
    axis.set_xlim(-0.5, len(space) + 0.1)
    axis.set_ylim(-0.05, 1.05)
    axis.spines[:].set_visible(False)
    for file in files:
        figure.savefig(file, dpi=110)
