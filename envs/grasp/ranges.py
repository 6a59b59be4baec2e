"""Ranges in settings."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, FiniteFloat


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    low, high = value
    if low > high:
        raise ValueError(f"a range goes from low to high, and {low} is above {high}")
    return value


Range = Annotated[tuple[FiniteFloat, FiniteFloat], AfterValidator(_ordered)]
