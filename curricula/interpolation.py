"""Evenly spaced values between two ends, straight or bent."""

import math
from typing import Literal, Self

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, model_validator


class Interpolation(BaseModel, frozen=True, extra="forbid"):
    """A row of values that begins at ``first`` and ends at ``last``.

    With t going evenly from 0 to 1 the values are

    - ``linear``: first + (last - first) * t
    - ``exponential``: first * (last / first) ** t, each the same multiple of the one before
    - ``power``: first + (last - first) * t ** power
    """

    first: FiniteFloat = Field(description="Value at the first lesson.")
    last: FiniteFloat = Field(description="Value at the last lesson.")
    interpolation: Literal["linear", "exponential", "power"] = Field(
        default="linear", description="How the values between the ends are spaced."
    )
    power: FiniteFloat | None = Field(
        default=None,
        gt=0,
        description="Exponent of the interpolation `power`: over 1 the values leave the first "
        "slowly, under 1 quickly.",
    )

    @model_validator(mode="after")
    def _fitting(self) -> Self:
        if (self.power is not None) != (self.interpolation == "power"):
            raise ValueError(
                f"interpolation {self.interpolation} with power {self.power}: give a power with "
                "'interpolation: power' and with that alone"
            )
        if self.interpolation == "exponential" and self.first * np.sign(self.last) <= 0:
            raise ValueError(
                f"an exponential interpolation cannot go from {self.first:g} to {self.last:g}: "
                "both must have the same sign and neither be zero; or choose linear"
            )
        if not math.isfinite(self.last - self.first) or (
            self.interpolation == "exponential" and not 0 < self.last / self.first < math.inf
        ):
            raise ValueError(
                f"{self.first:g} and {self.last:g} are too far apart for floating-point numbers"
            )
        return self

    def values(self, count: int) -> tuple[float, ...]:
        """``count`` values, the ends exact; a single value is the last one.

        Args:
            count: How many values, 0 or more.

        Returns:
            The values, from first to last.
        """
        if count < 2:
            return (self.last,) * count
        t = np.linspace(0.0, 1.0, count)
        if self.interpolation == "exponential":
            between = self.first * (self.last / self.first) ** t
        else:
            between = self.first + (self.last - self.first) * t ** (self.power or 1.0)
        return (self.first, *map(float, between[1:-1]), self.last)
