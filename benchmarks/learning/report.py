"""What came out: a table, and learning curves."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.learning.cases import OURS, PEER, PEER_NAMES, SIDES

HEAD = ("task", "steps", "algorithm", "seeds", "ventosa", "peer", "ventosa steps/s", "peer's")
COLORS = {OURS: "#0b6fb8", PEER: "#c1571b"}
Result = Mapping[str, Any]
"""What `benchmarks.learning.run` writes."""


def rows(results: Sequence[Result]) -> list[list[str]]:
    """A row of `HEAD` for each case, in the order they come.

    Returns are the means of the seeds' final returns with half their 95 % confidence interval;
    speeds are medians over the seeds.
    """
    return [
        [
            task,
            f"{steps:,}",
            algorithm,
            str(len(sides[OURS])),
            *(_return([run["final_return"] for run in sides[side]]) for side in SIDES),
            *(_speed(steps, [run["seconds"] for run in sides[side]]) for side in SIDES),
        ]
        for (algorithm, task, steps), sides in _by_case(results).items()
    ]


def _return(finals: Sequence[float]) -> str:
    return f"{statistics.mean(finals):,.0f} ± {half_interval(finals):,.0f}"


def _speed(steps: int, seconds: Sequence[float]) -> str:
    return f"{steps / statistics.median(seconds):,.0f}"


def half_interval(values: Sequence[float]) -> float:
    """Half the width of the 95 % confidence interval of a mean, by Student's t; NaN for one."""
    from scipy.special import stdtrit  # noqa: PLC0415  # of the extra `bench`

    if len(values) < 2:
        return math.nan
    factor = stdtrit(len(values) - 1, 0.975)
    return float(factor) * statistics.stdev(values) / math.sqrt(len(values))


def draw(results: Sequence[Result], folder: Path, stem: str) -> None:
    """Draws one picture of learning curves for each algorithm, `stem_algorithm.png`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  # of the extra `bench`

    cases = _by_case(results)
    for algorithm in dict.fromkeys(key[0] for key in cases):
        own = [(key, sides) for key, sides in cases.items() if key[0] == algorithm]
        figure = Figure(figsize=(4.2 * len(own), 3.2), layout="constrained")
        axes = figure.subplots(1, len(own), squeeze=False)[0]
        for axis, ((_, task, steps), sides) in zip(axes, own, strict=True):
            names = {OURS: f"ventosa {algorithm.upper()}", PEER: PEER_NAMES[algorithm]}
            for side, name in names.items():
                _draw_band(axis, sides[side], steps, label=name, color=COLORS[side])
            axis.set(title=task.replace("_", " "), xlabel="steps")
            axis.spines[["top", "right"]].set_visible(False)
        axes[0].set_ylabel("return of the deterministic policy")
        axes[0].legend(frameon=False)
        figure.savefig(folder / f"{stem}_{algorithm}.png", dpi=110)


def _draw_band(axis: Any, runs: Sequence[Result], steps: int, label: str, color: str) -> None:
    """The mean over the seeds, and its 95 % confidence interval."""
    at = np.linspace(0.0, steps, 21)[1:]
    curves = np.array([_interpolated(run, at) for run in runs])
    mean = curves.mean(axis=0)
    half = np.array([half_interval(column) for column in curves.T.tolist()])
    axis.plot(at, mean, color=color, label=label)
    axis.fill_between(at, mean - half, mean + half, color=color, alpha=0.15, linewidth=0)


def _interpolated(run: Result, at: NDArray[np.float64]) -> NDArray[np.float64]:
    steps, means = zip(*run["curve"], strict=True)
    return np.asarray(np.interp(at, steps, means))


def _by_case(results: Sequence[Result]) -> dict[tuple[str, str, int], dict[str, list[Result]]]:
    cases: dict[tuple[str, str, int], dict[str, list[Result]]] = {}
    for result in results:
        case = result["case"]
        key = (case["algorithm"], case["task"], case["steps"])
        cases.setdefault(key, {side: [] for side in SIDES})[result["side"]].append(result)
    return cases
