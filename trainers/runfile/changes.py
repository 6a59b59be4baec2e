"""What makes a run another one than the one that was begun."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trainers.runfile.settings import TRAINER_TYPE_KEY, TYPE_KEY, RunSettings, resolved
from trainers.runfile.yaml_document import KeyPath, dotted, shown


def changes(begun: RunSettings, now: RunSettings) -> list[str]:
    """Settings that differ, a line each: path, the value then and the value now.

    Those that a run may go on with other values of are passed over; see `changeable`.
    """
    free = changeable(now)
    return [
        f"{dotted(path)}: {shown(before)} then, {shown(after)} now"
        for path, before, after in differences(resolved(begun), resolved(now))
        if free.isdisjoint({dotted(path[:1]), dotted(path[:2])})
    ]


def changeable(run: RunSettings) -> set[str]:
    """Dotted paths of the settings that say how a run is computed or reported, not what it learns.

    Those are the device, the loggers, and what the settings of environment, trainer and evaluation
    have in a class variable `changeable_keys`.
    """
    sections = {
        "environment": run.environment.settings,
        "trainer": run.trainer.settings,
        "evaluation": run.evaluation,
    }
    return {"device", "loggers"} | {
        f"{name}.{key}"
        for name, settings in sections.items()
        for key in getattr(settings, "changeable_keys", ())
    }


def differences(before: Any, after: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any, Any]]:
    """Innermost values that differ, by their paths; of another component its type alone."""
    if isinstance(before, dict) and isinstance(after, dict):
        types = [key for key in (TYPE_KEY, TRAINER_TYPE_KEY) if before.get(key) != after.get(key)]
        for key in types or before | after:
            yield from differences(before.get(key), after.get(key), (*path, key))
    elif _are_sections(before) and _are_sections(after) and len(before) == len(after):
        for index, pair in enumerate(zip(before, after, strict=True)):
            yield from differences(*pair, (*path, index))
    elif before != after:
        yield path, before, after


def _are_sections(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, dict) for item in value)
