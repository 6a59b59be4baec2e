"""What validates can be built: whole numbers have limits, or their cost is held against memory."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import annotated_types
from pydantic import BaseModel

from trainers.runfile.listing import nested_models, type_name
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import EvaluationSettings

HELD_AGAINST_MEMORY = {"buffer_size", "time_horizon"}
NO_MORE_THAN_THE_BUFFER = {"batch_size", "buffer_init_steps"}
COST_NOTHING = {
    *("summary_freq", "checkpoint_interval", "keep_checkpoints", "interval"),
    *("episode_steps", "max_episode_steps", "sequence_length"),
    *("smoothing_episodes", "min_lesson_length", "every"),
    *("max_lifetime_restarts", "restarts_rate_limit_n"),
}
"""Are only counted up to, or divided by."""
CHECKED_TOGETHER = {"crop", "things", "patch", "layers"}
"""With the sensor or the image they are a part of, by a rule of their own, or one by one."""


def whole_numbers(model: type[BaseModel]) -> Iterator[tuple[str, Any]]:
    """Fields that are whole numbers, or have some in them, of a model and those within."""
    for name, field in model.model_fields.items():
        if re.search(r"\bint\b", type_name(field.annotation)):
            yield name, field
        for _, inner in nested_models(field.annotation):
            yield from whole_numbers(inner)


def limited(field: Any) -> bool:
    return any(isinstance(rule, annotated_types.Le | annotated_types.Lt) for rule in field.metadata)


def test_every_whole_number_has_a_limit_or_a_reason() -> None:
    registries = load_registries()
    every = [getattr(registries, kind.name) for kind in fields(registries)]
    models = [entry.settings for found in every for entry in found.entries.values()]
    reasons = HELD_AGAINST_MEMORY | NO_MORE_THAN_THE_BUFFER | COST_NOTHING | CHECKED_TOGETHER
    found = [pair for model in (*models, EvaluationSettings) for pair in whole_numbers(model)]
    assert len(found) > 50
    endless = {name for name, field in found if not limited(field)}
    assert endless == reasons
