"""Values of the command line over a run file's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel

from trainers.runfile.former_keys import tell
from trainers.runfile.inheritance import TYPE_KEYS
from trainers.runfile.registry import Registries
from trainers.runfile.validation import has, models_at
from trainers.runfile.yaml_document import COMMAND_LINE, Document, KeyPath, dotted

SECTIONS = {"environment": "environments", "curriculum": "curricula", "trainer": "trainers"}
ENTRIES = {"encoders": "encoders", "rewards": "rewards"}
"""Sections that are a component, or have some as their entries -> field of `Registries`."""


def override(document: Document, texts: Sequence[str], registries: Registries) -> None:
    """Sets values, from `KEY=VALUE` each; see `Document.override`.

    Where a part becomes one of another type, what is written for the former one goes if the new one
    has no such setting, and that is told: all but what the command line itself sets.

    Raises:
        SettingsError: see `Document.override`.
    """
    for text in texts:
        path = _path(text, document.data)
        former = _value(document.data, path)
        document.override(text)
        new = _value(document.data, path)
        if path[-1] in TYPE_KEYS and former is not None and former != new:
            part = path[:-1]
            gone = list(_drop_foreign(document, part, registries))
            if gone:
                names = ", ".join(dotted(key[len(part) :]) for key in gone)
                tell(f"{document.where(path)}: {dotted(part)}: {new} has none of {names}: left out")


def _drop_foreign(document: Document, part: KeyPath, registries: Registries) -> Iterator[KeyPath]:
    """Removes keys below a part that its component has no setting for; their paths."""
    length = 2 if part[0] in ENTRIES else 1
    section, model = part[:length], _settings(document, part[:length], registries)
    if model is None:
        return
    beside = {*TYPE_KEYS, "weight"} if part == section else set()
    data, whole = _value(document.data, part), _value(document.data, section)
    owners = models_at(model, part[length:], whole)
    for key in list(data):
        path = (*part, key)
        if owners and key not in beside and not any(key in own.model_fields for own in owners):
            if not document.where(path).startswith(COMMAND_LINE):
                del data[key]
                yield path
        elif isinstance(data[key], dict):
            yield from _drop_foreign(document, path, registries)


def _settings(
    document: Document, section: KeyPath, registries: Registries
) -> type[BaseModel] | None:
    """Model of a component's settings; None where there is no such component."""
    field = {**SECTIONS, **ENTRIES}.get(str(section[0]))
    data = _value(document.data, section)
    if field is None or not isinstance(data, dict):
        return None
    name = next((data[key] for key in TYPE_KEYS if key in data), None)
    entry = getattr(registries, field).entries.get(name)
    return None if entry is None else entry.settings


def _path(text: str, data: Any) -> KeyPath:
    """Path of an override's key; steps into lists are indices."""
    path: KeyPath = ()
    for step in text.partition("=")[0].split("."):
        index = int(step) if isinstance(data, list) and step.isdecimal() else step
        data = data[index] if has(data, index) else None
        path = (*path, index)
    return path


def _value(data: Any, path: KeyPath) -> Any:
    for step in path:
        data = data[step] if has(data, step) else None
    return data
