"""The settings that all trainers (algorithms) have in common."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel, Field


class TrainerSettings(BaseModel, frozen=True, extra="forbid"):
    """Length of the training, and intervals of reports and checkpoints."""

    # What a run may go on with other values of.
    changeable_keys: ClassVar[frozenset[str]] = frozenset(
        {"max_steps", "summary_freq", "checkpoint_interval", "keep_checkpoints"}
    )

    max_steps: int = Field(
        500_000, ge=1, le=10**12, description="Steps of the whole run, over all environments."
    )
    summary_freq: int = Field(10_000, ge=1, description="Steps between two summaries.")
    checkpoint_interval: int = Field(100_000, ge=1, description="Steps between two checkpoints.")
    keep_checkpoints: int = Field(5, ge=1, description="Checkpoints kept, next to the best.")
