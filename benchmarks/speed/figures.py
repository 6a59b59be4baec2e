"""What was measured, in one form for tables, picture and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.speed.timing import Samples

FRAME_GRAB = "frame grab"
STREAM = "stream"
MODES = {FRAME_GRAB: True, STREAM: False}
"""How images are observed, and the environment's setting `frame_grab` for it."""

OURS = "ventosa"
PEER = "stable-baselines3"
FAST = "fast"
PYBULLET = "pybullet"
RIVALS = {OURS: PEER, FAST: PYBULLET}
"""Whom each contender is compared with."""


@dataclass(frozen=True)
class Case:
    """What was measured.

    Attributes:
        what: such as `depth frames` or `training steps`; figures are of so many a second.
        size: side of the images in pixels.
        mode: one of `MODES`; empty where it makes no difference.
        num_envs: environments, or worlds of a simulator.
    """

    what: str
    size: int
    mode: str
    num_envs: int


@dataclass(frozen=True)
class Figure:
    """How fast one contender was, per second."""

    case: Case
    contender: str
    samples: Samples

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            **vars(self.case),
            "contender": self.contender,
            "per_second": self.samples.median,
            "range": [self.samples.low, self.samples.high],
            "samples": list(self.samples.values),
        }


def by_case(figures: Iterable[Figure]) -> dict[Case, dict[str, Figure]]:
    """The figures of each case by contender, in their order."""
    cases: dict[Case, dict[str, Figure]] = {}
    for figure in figures:
        cases.setdefault(figure.case, {})[figure.contender] = figure
    return cases


def speedup(figures: dict[str, Figure]) -> Samples | None:
    """How many times as fast the first of two rivals is; None where one is missing."""
    for name, rival in RIVALS.items():
        if name in figures and rival in figures:
            return figures[name].samples / figures[rival].samples
    return None


@dataclass(frozen=True)
class Growth:
    """How the time of one step of all environments grows with their number.

    Attributes:
        size: side of the images in pixels.
        mode: one of `MODES`.
        step_s: seconds by the number of environments.
        exponent: of N in the power law through them; 1 is growth in proportion.
    """

    size: int
    mode: str
    step_s: dict[int, float]
    exponent: float


def growth(figures: Sequence[Figure]) -> list[Growth]:
    """The growth of one contender's cost, for each size and mode with several N."""
    times: dict[tuple[int, str], dict[int, float]] = {}
    for figure in figures:
        case = figure.case
        steps_s = times.setdefault((case.size, case.mode), {})
        steps_s[case.num_envs] = case.num_envs / figure.samples.median
    return [
        Growth(size, mode, step_s, slope(step_s))
        for (size, mode), step_s in times.items()
        if len(step_s) > 1
    ]


def slope(step_s: dict[int, float]) -> float:
    """Slope of log(time) over log(N), by least squares."""
    x = [math.log(n) for n in step_s]
    y = [math.log(seconds) for seconds in step_s.values()]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    covariance = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True))
    return covariance / sum((a - mean_x) ** 2 for a in x)
