"""Environment parameters of the grasp task, set by lessons and samplers: their ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from curricula.samplers import ParameterValue
from envs.grasp.sensors.structured_light import MAX_STRENGTH
from envs.grasp.settings import MAX_GOAL_DEG, MAX_GOAL_M, MAX_NOISE_SIGMA_M, GraspSettings

GOAL_PARAMETERS = ("lateral_limit_m", "vertical_limit_m", "gap_limit_m", "yaw_limit_deg")
SENSOR_PARAMETERS = ("noise_sigma_m", "missing_fraction", "sensor_strength")
YAW_LIMIT = "block_yaw_limit_deg"


@dataclass(frozen=True)
class ParameterRange:
    """The values that an environment parameter may take.

    Attributes:
        low, high: the first and the last of them.
        rule: the same in words, and where it comes from.
    """

    low: float
    high: float
    rule: str

    def check(self, name: str, value: ParameterValue) -> None:
        """Refuses a number or a sampler that leaves the range.

        A Gaussian has no limits of its own: what it draws is clipped.

        Raises:
            ValueError: with the parameter's name, the value and the rule.
        """
        low, high = (value, value) if isinstance(value, int | float) else value.limits
        if (low, high) == (-math.inf, math.inf) or self.low <= low <= high <= self.high:
            return
        to = f" to {high:g}" if high > low else ""
        raise ValueError(f"environment parameter {name} {low:g}{to}: {self.rule}")

    def clip(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Drawn values (n,), within the range."""
        return values.clip(self.low, self.high)


def parameter_ranges(settings: GraspSettings) -> dict[str, ParameterRange]:
    """The ranges of all environment parameters, by name."""
    gap_min_m = settings.goal.gap_min_m
    limit_m, limit_deg = (
        ParameterRange(_over(0.0), most, f"a limit is over 0 and at most {most:g} {unit}")
        for most, unit in ((MAX_GOAL_M, "m"), (MAX_GOAL_DEG, "deg"))
    )
    return {
        "lateral_limit_m": limit_m,
        "vertical_limit_m": limit_m,
        "gap_limit_m": ParameterRange(
            _over(gap_min_m),
            MAX_GOAL_M,
            f"the largest gap is over the smallest one, {gap_min_m:g} "
            f"(environment.goal.gap_min_m), and at most {MAX_GOAL_M:g} m",
        ),
        "yaw_limit_deg": limit_deg,
        "noise_sigma_m": ParameterRange(
            0.0, MAX_NOISE_SIGMA_M, f"a sigma is within 0 and {MAX_NOISE_SIGMA_M:g} m"
        ),
        "missing_fraction": ParameterRange(0.0, 1.0, "a probability is within 0 and 1"),
        "sensor_strength": ParameterRange(
            0.0, MAX_STRENGTH, f"a strength is within 0 and {MAX_STRENGTH:g}"
        ),
        YAW_LIMIT: _block_yaw_limits(settings.randomize.block_yaw_deg),
    }


def _block_yaw_limits(block_yaw_deg: tuple[float, float]) -> ParameterRange:
    """The limits +- of the blocks' yaw that narrow its range.

    Below the first none of the range is left, over the last all of it.
    """
    low, high = block_yaw_deg
    least, most = max(low, -high, 0.0), max(abs(low), abs(high))
    return ParameterRange(
        least,
        most,
        f"the blocks' yaw goes from {low:g} to {high:g} deg (environment.randomize.block_yaw_deg), "
        f"which leaves {least:g} to {most:g}; change one of the two",
    )


def _over(number: float) -> float:
    """The next number."""
    return math.nextafter(number, math.inf)
