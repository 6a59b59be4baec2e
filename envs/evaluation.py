"""The contract of evaluation: what an environment declares of how its policies are judged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

PERCENT = "%"
Use = Literal["refuse", "learn", "measure"]


@dataclass(frozen=True)
class Figure:
    """One number that a policy is judged by, made of a metric of many episodes.

    Attributes:
        metric: a key of the infos' `episode_metrics`.
        label: what people call it.
        key: its name in reports, in the metric's own unit; empty: the metric's name.
        unit: what people read it in.
        scale: from the metric's own unit to that one.
        better: which way is better; None where neither is.
        summary: `mean` for rates, `quantiles` (median and 95th percentile) for errors.
    """

    metric: str
    label: str
    key: str = ""
    unit: str = ""
    scale: float = 1.0
    better: Literal["higher", "lower"] | None = "higher"
    summary: Literal["mean", "quantiles"] = "mean"

    @property
    def name(self) -> str:
        """The key in reports."""
        return self.key or self.metric

    def of_first_action(self) -> Figure:
        """The same figure, of a policy's first action alone."""
        return replace(self, key=f"first_action_{self.name}", label=f"first action {self.label}")

    def summarize(self, values: NDArray[Any]) -> float | dict[str, float]:
        """Entry of a report, made of the metric (k,) of k episodes."""
        if self.summary == "mean":
            return float(np.mean(values))
        return {"median": float(np.median(values)), "p95": float(np.percentile(values, 95))}

    def shown(self, value: float) -> str:
        """A value as people read it: `98.5%`, `2.41 mm`, `-0.163`."""
        if self.unit == PERCENT:
            return f"{value * self.scale:.1f}%"
        return f"{value * self.scale:.2f} {self.unit}" if self.unit else f"{value * self.scale:.3f}"


def rate(
    metric: str, label: str, key: str = "", better: Literal["higher", "lower"] = "higher"
) -> Figure:
    """The share of episodes that something is true of."""
    return Figure(metric, label, key, PERCENT, 100.0, better)


def error(metric: str, label: str, unit: str, scale: float = 1.0) -> Figure:
    """A distance from what is wanted, in the metric's unit times `scale`."""
    return Figure(metric, label, "", unit, scale, "lower", "quantiles")


SUCCESS = rate("success", "success")
"""Figure that every environment may report, and need not declare."""


@dataclass(frozen=True)
class Unanswerable:
    """Observations before which no action is right.

    Attributes:
        kind: what is the matter with them.
        observations: arrays (n, ...) by name; those that only a critic sees are left out.
        use: `refuse`: policies learn from them to be unsure, and what is sure is chosen so that
            next to none of them is; `learn`: they learn from them, and that is all, because some
            are nearly what can be answered; `measure`: they tell what happens before what nobody
            thought of.
    """

    kind: str
    observations: Mapping[str, NDArray[Any]]
    use: Use = "refuse"

    def __post_init__(self) -> None:
        if self.use not in get_args(Use):
            raise ValueError(f"{self.kind}: use {self.use!r} is none of {', '.join(get_args(Use))}")


class PhysicalCheck(Protocol):
    """Carries out actions in a world with full physics, apart from the episodes.

    One that takes its time may count in an attribute `tried_out` the actions that it is through
    with, since it was made: the terminal shows that.
    """

    def __call__(self, actions: NDArray[Any]) -> dict[str, NDArray[np.bool_]]:
        """Tries out actions (n, ...) in the first n environments, whose episodes do not notice.

        Returns:
            By name (n,): `success`, and each reason of failure; one of them is true of every row.
        """

    def close(self) -> None:
        """Frees what it holds; calling it twice does no harm."""


class EvaluationReport(Protocol):
    """Pictures of a policy's actions, for people to look at.

    Attributes:
        file_names: what `files` makes.
    """

    file_names: tuple[str, ...]

    def add(self, actions: NDArray[Any], outcomes: Mapping[str, NDArray[np.bool_]]) -> None:
        """Takes up actions (n, ...) in the first n environments, before they are carried out.

        Args:
            actions: those of the policy.
            outcomes: what the physical check says of them; empty where there was none.
        """

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Draws everything: names and contents of files."""


class Evaluator:
    """Rules by which an environment's policies are judged. What is not declared is left out.

    Attributes:
        figures: of the environment's episode metrics. Success needs no declaration.
        judges_first_action: the deterministic policy's first action is judged by itself, and the
            whole episodes are played as at the end of training, exploration and all; otherwise
            the deterministic policy plays them. The `episode_metrics` must then be there after an
            episode's first action, as if it ended with it.
        check_name: what reports call the physical check.
        answer_limits: of episode metrics that are errors, by name, none below 0: a first action is
            right where none is over its limit. Of a metric whose limit is 0 any is too much.
    """

    figures: tuple[Figure, ...] = ()
    answer_limits: Mapping[str, float] = MappingProxyType({})
    judges_first_action: bool = False
    check_name: str = "check"

    def physical_check(self, *, window: bool = False) -> PhysicalCheck:
        """Physical check that first actions are tried out in.

        Args:
            window: show it, as it goes.

        Raises:
            ValueError: there is none, or it can't be had as asked for.
        """
        raise ValueError("the environment has no physical check")

    def pictures(self) -> EvaluationReport:
        """Report that draws first actions.

        Raises:
            ValueError: there is nothing to draw, or something needed for it is not installed.
        """
        raise ValueError("the environment has no pictures to show")

    def drawn(self, actions: NDArray[Any]) -> NDArray[np.uint8] | None:
        """Picture (H, W, 3) of what the first environments show, target and action drawn in.

        Args:
            actions: (n, ...) in the first n environments, before they are carried out.

        Returns:
            None: there is no such picture.
        """
        return None

    def unanswerable(self, count: int, seed: int) -> Iterator[Unanswerable]:
        """Observations of all kinds before which no action is right; the episodes do not notice.

        Args:
            count: how many of each kind.
            seed: of what is drawn for them.
        """
        yield from ()


def right_answers(
    metrics: Mapping[str, NDArray[Any]], limits: Mapping[str, float]
) -> NDArray[np.bool_]:
    """Which of k actions are right, (k,): those with none of these metrics over its limit.

    Args:
        metrics: by name (k,), of the actions.
        limits: of at least one of them; see `Evaluator.answer_limits`.
    """
    within = [metrics[name] <= limit for name, limit in limits.items()]
    return np.asarray(np.all(within, axis=0))


@dataclass(frozen=True)
class RunFileOption:
    """An option of evaluation's command line that stands for a key of the run file.

    Attributes:
        flag: such as `--track`.
        help: for the command line's `--help`.
        key: the dotted path, such as `environment.track`.
    """

    flag: str
    help: str
    key: str


@dataclass(frozen=True)
class PhysicalCheckOption:
    """An option of evaluation's command line that asks for the physical check.

    Attributes:
        flag: such as `--drive`.
        help: for the command line's `--help`.
        window: show it, as it goes.
    """

    flag: str
    help: str
    window: bool = False


EvaluationOption = RunFileOption | PhysicalCheckOption
