"""Runs side by side: a table as Markdown, and the learning curves as a figure."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trainers.common.files import write_atomically
from trainers.comparison.results import Curve, RunResult
from trainers.comparison.tables import markdown
from trainers.reporting.figures import figure_values

HEAD = (
    "experiment",
    "seeds",
    "steps",
    "final reward",
    "best reward",
    "success",
    "lesson",
    "hours",
    "ended",
)
POINTS = 101
"""Of a curve in the figure."""
COLUMNS = 4
Experiments = Mapping[str, Sequence[RunResult]]
"""Runs that differ in their seeds alone, by the name of what they have in common."""


def write_report(experiments: Experiments, folder: Path) -> Path:
    """Writes `report.md` with its figure; returns the page.

    Args:
        experiments: at least one, each of at least one run.
        folder: is made; files of those names are replaced.

    Raises:
        OSError: the folder can't be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    draw(experiments, [folder / "rewards.png", folder / "rewards.svg"])
    page = folder / "report.md"
    write_atomically(page, "\n".join(lines(experiments)) + "\n")
    return page


def lines(experiments: Experiments) -> Iterator[str]:
    """The page."""
    yield "# Runs side by side"
    yield ""
    yield "Medians over the seeds, the lowest and the highest in brackets."
    yield ""
    yield from markdown(HEAD, [row(name, runs) for name, runs in experiments.items()])
    yield ""
    yield "![Cumulative reward over steps](rewards.png)"
    if names := _figure_names(experiments):
        yield ""
        yield "## Held-out evaluation"
        yield ""
        yield from markdown(
            ["figure", *experiments],
            [
                [name, *(_of_evaluation(runs, name) for runs in experiments.values())]
                for name in names
            ],
        )


def row(name: str, runs: Sequence[RunResult]) -> list[str]:
    """The cells of an experiment, as `HEAD` names them."""
    return [
        name,
        str(len(runs)),
        f"{statistics.median(run.step for run in runs):,.0f}",
        spread(_values(runs, lambda run: run.reward[1][-1])),
        spread(_values(runs, lambda run: run.reward[1].max())),
        spread([100.0 * value for value in _values(runs, _success)], " %"),
        _lessons(runs),
        f"{statistics.median(run.seconds for run in runs) / 3600.0:.2f}",
        ", ".join(dict.fromkeys(_ended(run) for run in runs)),
    ]


def spread(values: Sequence[float], unit: str = "") -> str:
    """The median, with the lowest and the highest; empty where there are no values."""
    if not values:
        return ""
    middle = f"{statistics.median(values):.3g}{unit}"
    if len(values) == 1:
        return middle
    return f"{middle} ({min(values):.3g} to {max(values):.3g})"


def draw(experiments: Experiments, files: Sequence[Path]) -> None:
    """Draws a panel for each experiment: its seeds as a band, their median thick."""
    from matplotlib.figure import Figure  # noqa: PLC0415  # of the extra `render`

    columns = min(COLUMNS, len(experiments))
    rows = -(-len(experiments) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.6 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis, (name, runs) in zip(axes, experiments.items(), strict=False):
        steps, curves = common_curves([run.reward for run in runs])
        axis.set_title(name)
        axis.spines[["top", "right"]].set_visible(False)
        if len(steps):
            axis.fill_between(steps, curves.min(0), curves.max(0), alpha=0.25, linewidth=0)
            axis.plot(steps, np.median(curves, axis=0), linewidth=2.0)
    for axis in axes[len(experiments) :]:
        axis.set_axis_off()
    figure.supxlabel("steps")
    figure.supylabel("cumulative reward")
    for file in files:
        figure.savefig(file, dpi=110)


def common_curves(curves: Sequence[Curve]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Curves at the same steps (k,): values (n, k), up to where the shortest one ends."""
    drawn = [curve for curve in curves if len(curve[0])]
    if not drawn:
        return np.empty(0), np.empty((0, 0))
    first, last = max(c[0][0] for c in drawn), min(c[0][-1] for c in drawn)
    steps = np.linspace(first, max(first, last), POINTS)
    return steps, np.stack([np.interp(steps, at, values) for at, values in drawn])


def _values(runs: Sequence[RunResult], value: Callable[[RunResult], float | None]) -> list[float]:
    """One for each run that has any reward, and that value."""
    found = [value(run) for run in runs if len(run.reward[0])]
    return [float(number) for number in found if number is not None]


def _success(run: RunResult) -> float | None:
    """Of the held-out evaluation if there was one, of training otherwise."""
    evaluated = run.evaluation
    return evaluated.get(
        "first_action_success", evaluated.get("success", run.status.get("success"))
    )


def _lessons(runs: Sequence[RunResult]) -> str:
    reached = [int(run.status.get("lesson") or 0) for run in runs]
    count = max(int(run.status.get("lessons") or 0) for run in runs)
    return f"{statistics.median_low(reached)} of {count}" if count > 1 else ""


def _ended(run: RunResult) -> str:
    state, reason = run.status.get("state", "never begun"), run.status.get("reason", "")
    return state if state == "finished" or not reason else f"{state}: {reason}"


def _figure_names(experiments: Experiments) -> list[str]:
    names: dict[str, None] = {}
    for runs in experiments.values():
        for run in runs:
            names |= dict.fromkeys(_evaluated(run))
    return list(names)


def _evaluated(run: RunResult) -> dict[str, float]:
    found = figure_values(run.evaluation)
    return {" ".join(filter(None, (key, part))): value for key, part, value in found}


def _of_evaluation(runs: Sequence[RunResult], name: str) -> str:
    return spread([value[name] for run in runs if name in (value := _evaluated(run))])
