"""Figures of an evaluation: what a report says of episodes, and how people read it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.evaluation import SUCCESS, Evaluator, Figure, rate, right_answers
from trainers.common.errors import UserError, suggestion

Metrics = Mapping[str, NDArray[Any]]
"""By name (k,), what was reported of k episodes, or of k actions."""


SURE, SURE_RIGHT = "sure", "sure_right"

FACTS = ("step", "episodes", "seed")
"""Entries of a report that say what was evaluated, and are no figures."""


def figure_values(report: Mapping[str, Any]) -> Iterator[tuple[str, str, float]]:
    """The values of a report's figures: the entry's key, the part of it (`p95`), the number.

    The part is empty where the entry is one number.
    """
    for key, value in report.items():
        if key not in FACTS:
            parts = value.items() if isinstance(value, Mapping) else (("", value),)
            # What is not finite is null in JSON.
            yield from ((key, part, float(number)) for part, number in parts if number is not None)


def evaluation_tag(key: str, part: str = "") -> str:
    """The TensorBoard tag of a report's figure."""
    return f"Evaluation/{f'{key} {part}'.strip().replace('_', ' ').title()}"


def report_figures(evaluator: Evaluator) -> dict[str, Figure]:
    """Figures of a report's entries, by their keys; what is not here is a plain number."""
    name, label = evaluator.check_name, evaluator.check_name.replace("_", " ")
    figures = (
        Figure("reward", "reward"),
        *episode_figures(evaluator),
        *first_action_figures(evaluator),
        rate(SURE, "first action: sure"),
        rate(SURE_RIGHT, "first action: right where sure"),
        rate(f"{name}_rate", f"{label} rate"),
        rate(f"{name}_failures", f"{label} failures", better="lower"),
    )
    return {figure.name: figure for figure in figures}


def episode_figures(evaluator: Evaluator) -> tuple[Figure, ...]:
    """Figures of whole episodes."""
    figures = (SUCCESS, *evaluator.figures)
    if not evaluator.judges_first_action:
        return figures
    return tuple(figure for figure in figures if figure.summary == "mean")


def first_action_figures(evaluator: Evaluator) -> tuple[Figure, ...]:
    """Figures of the first action, where it is judged."""
    return tuple(
        figure.of_first_action() if figure.summary == "mean" else figure
        for figure in (SUCCESS, *evaluator.figures)
    )


def summaries(figures: Sequence[Figure], metrics: Metrics) -> dict[str, Any]:
    """Entries of a report, made of episodes' metrics (k,)."""
    for figure in figures:
        if figure.metric not in (*metrics, SUCCESS.metric):
            raise UserError(
                f"the environment's figure {figure.name!r} is made of {figure.metric!r}, which is "
                f"not among its episode metrics; {suggestion(figure.metric, metrics)}"
            )
    return {f.name: f.summarize(metrics[f.metric]) for f in figures if f.metric in metrics}


def check_report(name: str, outcomes: Metrics) -> dict[str, Any]:
    """The shares of a physical check's outcomes (k,)."""
    if not outcomes:
        return {}
    rates = {outcome: float(rows.mean()) for outcome, rows in outcomes.items()}
    return {f"{name}_rate": rates.pop(SUCCESS.metric), f"{name}_failures": rates}


def sureness_report(
    sure: NDArray[np.bool_], limits: Mapping[str, float], metrics: Metrics
) -> dict[str, float]:
    """How often a policy is sure (k,), and how many of those actions are right.

    Args:
        sure: whether it is, of k actions.
        limits: an action is right where none of these metrics is over its limit.
        metrics: of the same k actions.
    """
    report = {SURE: float(sure.mean())}
    if limits and sure.any():
        report[SURE_RIGHT] = float(right_answers(metrics, limits)[sure].mean())
    return report
