"""What came out: a table, a page, and learning curves."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table
from scipy.special import stdtrit

from benchmarks.learning.cases import OURS, PEER, PEER_NAMES, SIDES
from benchmarks.page import markdown, write_between

HEAD = ("task", "steps", "algorithm", "seeds", "ventosa", "peer", "ventosa steps/s", "peer's")
COLORS = {OURS: "#0b6fb8", PEER: "#c1571b"}
Result = Mapping[str, Any]


@dataclass(frozen=True)
class Side:
    """What one side reached in one case.

    Attributes:
        mean: of the seeds' mean final returns.
        interval: half the width of its 95 % confidence interval; NaN for a single seed.
        steps_per_second: of training, the median of the seeds.
    """

    mean: float
    interval: float
    steps_per_second: float


@dataclass(frozen=True)
class Summary:
    """One case: an algorithm on a task."""

    algorithm: str
    task: str
    steps: int
    seeds: int
    sides: Mapping[str, Side]


def summaries(results: Sequence[Result]) -> list[Summary]:
    """The cases in the order they come."""
    return [
        Summary(
            algorithm,
            task,
            steps,
            len(runs[OURS]),
            {side: _side(runs[side], steps) for side in SIDES if runs[side]},
        )
        for (algorithm, task, steps), runs in _by_case(results).items()
    ]


def _side(runs: Sequence[Result], steps: int) -> Side:
    finals = [run["final_return"] for run in runs]
    seconds = statistics.median(run["seconds"] for run in runs)
    return Side(statistics.mean(finals), half_interval(finals), steps / seconds)


def half_interval(values: Sequence[float]) -> float:
    """Half the width of the 95 % confidence interval of a mean, by Student's t."""
    if len(values) < 2:
        return math.nan
    factor = stdtrit(len(values) - 1, 0.975)
    return float(factor) * statistics.stdev(values) / math.sqrt(len(values))


def table(found: Sequence[Summary]) -> Table:
    """The figures for people."""
    result = Table(title="mean final return (95 % confidence) and steps/s while training")
    for column in HEAD:
        result.add_column(column, justify="left" if column in {"task", "algorithm"} else "right")
    for row in _rows(found):
        result.add_row(*row)
    return result


def write_page(path: Path, found: Sequence[Summary]) -> None:
    """Writes the figures between the markers of a Markdown page, which must be there."""
    write_between(path, "learning", markdown(HEAD, _rows(found)))


def _rows(found: Sequence[Summary]) -> list[list[str]]:
    return [
        [
            case.task,
            f"{case.steps:,}",
            case.algorithm,
            str(case.seeds),
            *(_return(case.sides.get(side)) for side in SIDES),
            *(_speed(case.sides.get(side)) for side in SIDES),
        ]
        for case in found
    ]


def _return(side: Side | None) -> str:
    return "" if side is None else f"{side.mean:,.0f} ± {side.interval:,.0f}"


def _speed(side: Side | None) -> str:
    return "" if side is None else f"{side.steps_per_second:,.0f}"


def draw(results: Sequence[Result], folder: Path) -> None:
    """Draws one picture of learning curves for each algorithm."""
    cases = _by_case(results)
    for algorithm in dict.fromkeys(key[0] for key in cases):
        own = [(key, runs) for key, runs in cases.items() if key[0] == algorithm]
        figure = Figure(figsize=(4.2 * len(own), 3.2), layout="constrained")
        axes = figure.subplots(1, len(own), squeeze=False)[0]
        for axis, ((_, task, steps), runs) in zip(axes, own, strict=True):
            for side in SIDES:
                if runs[side]:
                    _draw_band(axis, runs[side], steps, side, algorithm)
            axis.set_title(task.replace("_", " "))
            axis.set_xlabel("steps")
            axis.spines[["top", "right"]].set_visible(False)
        axes[0].set_ylabel("return of the deterministic policy")
        axes[0].legend(frameon=False)
        figure.savefig(folder / f"learning_{algorithm}.png", dpi=110)


def _draw_band(axis: Any, runs: Sequence[Result], steps: int, side: str, algorithm: str) -> None:
    """The mean over the seeds, and its 95 % confidence interval."""
    at = np.linspace(0.0, steps, 21)[1:]
    curves = np.array([_interpolated(run, at) for run in runs])
    mean = curves.mean(axis=0)
    half = np.array([half_interval(column) for column in curves.T.tolist()])
    name = f"ventosa {algorithm.upper()}" if side == OURS else PEER_NAMES[algorithm]
    axis.plot(at, mean, color=COLORS[side], label=name)
    axis.fill_between(at, mean - half, mean + half, color=COLORS[side], alpha=0.15, linewidth=0)


def _interpolated(run: Result, at: NDArray[np.float64]) -> NDArray[np.float64]:
    steps, means = zip(*run["curve"], strict=True)
    return np.asarray(np.interp(at, steps, means))


def _by_case(
    results: Sequence[Result],
) -> dict[tuple[str, str, int], dict[str, list[Result]]]:
    cases: dict[tuple[str, str, int], dict[str, list[Result]]] = {}
    for result in results:
        case = result["case"]
        key = (case["algorithm"], case["task"], case["steps"])
        cases.setdefault(key, {side: [] for side in SIDES})[result["side"]].append(result)
    return cases
