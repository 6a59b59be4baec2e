"""Samplers of environment parameters, written in a run file as ML-Agents has them.

A parameter is a plain number (a constant) or a sampler, drawn anew at every reset::

    noise_sigma_m: {sampler_type: gaussian, sampler_parameters: {mean: 0.002, st_dev: 0.0005}}
    yaw_limit_deg: {sampler_type: uniform, sampler_parameters: {min_value: 2, max_value: 10}}
    block_yaw_limit_deg:
      sampler_type: multirangeuniform
      sampler_parameters: {intervals: [[5, 10], [20, 30]]}
    lateral_limit_m: 0.01
"""

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Discriminator, Field, FiniteFloat, Tag, model_validator

Interval = tuple[FiniteFloat, FiniteFloat]


class UniformParameters(BaseModel, frozen=True, extra="forbid"):
    """Bounds of a uniform distribution, in the parameter's own unit."""

    min_value: FiniteFloat = Field(description="Smallest value that can be drawn.")
    max_value: FiniteFloat = Field(description="Upper bound of the values; at least min_value.")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_value > self.max_value:
            raise ValueError(
                f"min_value {self.min_value:g} is greater than max_value {self.max_value:g}: "
                "swap the two"
            )
        _check_finite_width(self.min_value, self.max_value)
        return self


class GaussianParameters(BaseModel, frozen=True, extra="forbid"):
    """Moments of a normal distribution, in the parameter's own unit."""

    mean: FiniteFloat = Field(description="Mean of the values.")
    st_dev: FiniteFloat = Field(ge=0, description="Standard deviation of the values.")


class MultiRangeUniformParameters(BaseModel, frozen=True, extra="forbid"):
    """Intervals of a distribution with the same density in all of them."""

    intervals: tuple[Interval, ...] = Field(
        min_length=1,
        description="Pairs [min, max]; an interval is picked in proportion to its width.",
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for start, stop in self.intervals:
            if start > stop:
                raise ValueError(
                    f"the interval [{start:g}, {stop:g}] has its min over its max: swap the two"
                )
            if start == stop:
                raise ValueError(
                    f"the interval [{start:g}, {stop:g}] has no width and would never be picked: "
                    "widen it or leave it out"
                )
        _check_finite_width(0.0, sum(stop - start for start, stop in self.intervals))
        return self


class UniformSampler(BaseModel, frozen=True, extra="forbid"):
    """Every value between two bounds is equally likely."""

    sampler_type: Literal["uniform"] = Field(description="Name of the distribution.")
    sampler_parameters: UniformParameters = Field(description="Its bounds.")

    @property
    def limits(self) -> Interval:
        """Smallest and largest value."""
        return self.sampler_parameters.min_value, self.sampler_parameters.max_value

    def sample(self, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
        """Draw ``size`` independent values.

        Args:
            rng: Source of randomness; advanced by the call.
            size: How many values.

        Returns:
            Values of shape (size,), in the parameter's own unit.
        """
        bounds = self.sampler_parameters
        return rng.uniform(bounds.min_value, bounds.max_value, size)


class GaussianSampler(BaseModel, frozen=True, extra="forbid"):
    """Values are normally distributed, without bounds."""

    sampler_type: Literal["gaussian"] = Field(description="Name of the distribution.")
    sampler_parameters: GaussianParameters = Field(description="Its mean and deviation.")

    @property
    def limits(self) -> Interval:
        """Smallest and largest value: there are none."""
        return -math.inf, math.inf

    def sample(self, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
        """Draw ``size`` independent values; see `UniformSampler.sample`."""
        moments = self.sampler_parameters
        return rng.normal(moments.mean, moments.st_dev, size)


class MultiRangeUniformSampler(BaseModel, frozen=True, extra="forbid"):
    """Values are uniform over several intervals, each picked in proportion to its width.

    Where intervals overlap, the density is the sum of theirs.
    """

    sampler_type: Literal["multirangeuniform"] = Field(description="Name of the distribution.")
    sampler_parameters: MultiRangeUniformParameters = Field(description="Its intervals.")

    @property
    def limits(self) -> Interval:
        """Smallest and largest value."""
        starts, stops = zip(*self.sampler_parameters.intervals, strict=True)
        return min(starts), max(stops)

    def sample(self, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
        """Draw ``size`` independent values; see `UniformSampler.sample`."""
        starts, stops = np.array(self.sampler_parameters.intervals, dtype=np.float64).T
        # Lay the intervals end to end, draw one point of the whole, and carry it back.
        ends = np.cumsum(stops - starts)
        point = rng.uniform(0.0, ends[-1], size)
        index = np.minimum(np.searchsorted(ends, point, side="right"), len(ends) - 1)
        return np.clip(stops[index] - (ends[index] - point), starts[index], stops[index])


Sampler = Annotated[
    UniformSampler | GaussianSampler | MultiRangeUniformSampler,
    Field(discriminator="sampler_type"),
]


def _kind(value: Any) -> str | None:
    """Tell which member of `ParameterValue` is meant, so that errors speak of that one alone."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "number"
    if isinstance(value, dict | UniformSampler | GaussianSampler | MultiRangeUniformSampler):
        return "sampler"
    return None


ParameterValue = Annotated[
    Annotated[FiniteFloat, Tag("number")] | Annotated[Sampler, Tag("sampler")],
    Discriminator(
        _kind,
        custom_error_type="parameter_value",
        custom_error_message="Input should be a number or a sampler: "
        "{sampler_type: ..., sampler_parameters: ...}",
    ),
]
"""Type of a field that holds an environment parameter: a number or a sampler."""


def draw(value: ParameterValue, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Draw ``size`` values of a parameter; a plain number is drawn without using ``rng``.

    Args:
        value: A number or a sampler.
        rng: Source of randomness.
        size: How many values.

    Returns:
        Values of shape (size,), in the parameter's own unit.
    """
    if isinstance(value, int | float):
        return np.full(size, value, dtype=np.float64)
    return value.sample(rng, size)


def _check_finite_width(start: float, stop: float) -> None:
    if not math.isfinite(stop - start):
        raise ValueError("the range is too wide for a floating-point number: narrow it")
