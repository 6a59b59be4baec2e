"""Runs side by side: a table as Markdown, and the learning curves as a figure."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
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
    "success in training",
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
    yield (
        "Medians over the seeds, the lowest and the highest in brackets. Success in training is of "
        "actions as they are drawn, by the limits of the lesson that was reached."
    )
    yield ""
    yield from markdown(HEAD, [row(name, runs) for name, runs in experiments.items()])
    yield ""
    yield "![Cumulative reward over steps](rewards.png)"
    if names := _figure_names(experiments):
        yield ""
        yield "## Held-out evaluation"
        yield ""
        yield "The last one of each run, in episodes that training does not draw."
        yield ""
        yield from markdown(
            ["experiment", *names.values()],
            [
                [experiment, *(_of_evaluation(runs, key) for key in names)]
                for experiment, runs in experiments.items()
            ],
        )


def row(name: str, runs: Sequence[RunResult]) -> list[str]:
    """The cells of an experiment, as `HEAD` names them."""
    rewards = [run.reward[1] for run in runs if len(run.reward[1])]
    successes = [run.status["success"] for run in runs if run.status.get("success") is not None]
    return [
        name,
        str(len(runs)),
        f"{statistics.median(run.step for run in runs):,.0f}",
        spread([values[-1] for values in rewards]),
        spread([values.max() for values in rewards]),
        spread([100.0 * success for success in successes], " %"),
        _lessons(runs),
        f"{statistics.median(run.seconds for run in runs) / 3600.0:.2f}",
        ", ".join(dict.fromkeys(_ended(run) for run in runs)),
    ]


def spread(values: Sequence[float], unit: str = "") -> str:
    """The median, with the lowest and the highest; empty where there are no values."""
    if not values:
        return ""
    middle = f"{_shown(statistics.median(values))}{unit}"
    if len(values) == 1:
        return middle
    return f"{middle} ({_shown(min(values))} to {_shown(max(values))})"


def _shown(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


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
            lowest, highest = np.nanmin(curves, axis=0), np.nanmax(curves, axis=0)
            axis.fill_between(steps, lowest, highest, alpha=0.25, linewidth=0)
            axis.plot(steps, np.nanmedian(curves, axis=0), linewidth=2.0)
    for axis in axes[len(experiments) :]:
        axis.set_axis_off()
    figure.supxlabel("steps")
    figure.supylabel("cumulative reward")
    for file in files:
        figure.savefig(file, dpi=110)


def common_curves(curves: Sequence[Curve]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Curves at the same steps (k,): values (n, k), NaN where one has none."""
    drawn = [curve for curve in curves if len(curve[0])]
    if not drawn:
        return np.empty(0), np.empty((0, 0))
    first, last = min(c[0][0] for c in drawn), max(c[0][-1] for c in drawn)
    steps = np.linspace(first, last, POINTS)
    found = np.stack(
        [np.interp(steps, at, values, left=np.nan, right=np.nan) for at, values in drawn]
    )
    is_any = np.isfinite(found).any(axis=0)
    return steps[is_any], found[:, is_any]


def _lessons(runs: Sequence[RunResult]) -> str:
    reached = [int(run.status.get("lesson") or 0) for run in runs]
    count = max(int(run.status.get("lessons") or 0) for run in runs)
    return f"{statistics.median_low(reached)} of {count}" if count > 1 else ""


def _ended(run: RunResult) -> str:
    state, reason = run.status.get("state", "unknown"), run.status.get("reason", "")
    told = state if state == "finished" or not reason else f"{state}: {reason}"
    return told if run.cut_at is None else f"{told} (its curves end at step {run.cut_at:,})"


def _figure_names(experiments: Experiments) -> dict[str, str]:
    """Heads of the columns by the keys of evaluations: `error_m median / p95`."""
    names: dict[str, str] = {}
    for runs in experiments.values():
        for run in runs:
            for key, parts in _evaluated(run).items():
                names.setdefault(key, f"{key} {' / '.join(parts)}".strip())
    return names


def _evaluated(run: RunResult) -> dict[str, dict[str, float]]:
    """Values by key and part, which is empty where the entry is one number."""
    found: dict[str, dict[str, float]] = {}
    for key, part, value in figure_values(run.evaluation):
        found.setdefault(key, {})[part] = value
    return found


def _of_evaluation(runs: Sequence[RunResult], key: str) -> str:
    found = [value[key] for run in runs if key in (value := _evaluated(run))]
    parts = dict.fromkeys(part for value in found for part in value)
    values = {part: [value[part] for value in found if part in value] for part in parts}
    if "" in values:
        return spread(values[""])
    return " / ".join(_shown(statistics.median(numbers)) for numbers in values.values())
