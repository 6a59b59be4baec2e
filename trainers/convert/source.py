"""ML-Agents' trainer configuration, as it was written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainers.common.errors import UserError, suggestion
from trainers.convert.keys import FORMER_BEHAVIOR, FORMER_TOP
from trainers.runfile.yaml_document import Document, KeyPath, Problem, SettingsError, read, shown

BEHAVIORS = "behaviors"
DEFAULT_SETTINGS = "default_settings"


@dataclass(frozen=True)
class Source:
    """A file that is ML-Agents'."""

    document: Document

    @classmethod
    def read(cls, path: Path) -> Source:
        """Reads a file.

        Raises:
            SettingsError: it can't be read, is no YAML, or is not ML-Agents' or not of its present
                format.
        """
        source = cls(read(path))
        data = source.document.data
        if {"environment", "trainer"} <= data.keys():
            message = f"is a run file already: python -m trainers.learn {path}"
        elif FORMER_TOP & data.keys() or any(
            isinstance(own, dict) and FORMER_BEHAVIOR & own.keys()
            for own in source.section(BEHAVIORS).values()
        ):
            message = (
                "is of ML-Agents before its release 7, whose own `python -m "
                "mlagents.trainers.upgrade_config` brings it up to date"
            )
        elif not source.section(BEHAVIORS):
            message = f"is no trainer configuration of ML-Agents': it has no `{BEHAVIORS}`"
        else:
            return source
        raise SettingsError([Problem(source.document.origin, (), message)])

    def section(self, *path: str) -> dict[str, Any]:
        """A section; empty where it is absent or null.

        Raises:
            SettingsError: it is no mapping.
        """
        section: Any = self.document.data
        for step in path:
            section = section.get(step) or {}
        if not isinstance(section, dict):
            raise SettingsError(
                [self.problem(path, f"should be a mapping (key: value), not {shown(section)}")]
            )
        return section

    def choose(self, behavior: str | None) -> str:
        """Name of the behavior that is asked for, or of the only one.

        Raises:
            UserError: there is no such behavior, or there are several.
        """
        names, origin = list(self.section(BEHAVIORS)), self.document.origin
        if behavior is None and len(names) > 1:
            raise UserError(
                f"{origin}: has several behaviors, each a run of its own: choose one with "
                f"--behavior: {', '.join(names)}"
            )
        if behavior is not None and behavior not in names:
            raise UserError(
                f"--behavior {behavior}: {origin} has no such behavior; "
                f"{suggestion(behavior, names)}"
            )
        return behavior or names[0]

    def problem(self, path: KeyPath, message: str) -> Problem:
        """Something to be put right at a place of the file."""
        return Problem(self.document.where(path), path, message)


def leaves(data: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """Values that are no mappings, or empty ones, and their paths; lists of mappings have some."""
    if isinstance(data, dict) and (data or not path):
        for key, value in data.items():
            yield from leaves(value, (*path, key))
    elif isinstance(data, list) and any(isinstance(item, dict) for item in data):
        for index, item in enumerate(data):
            yield from leaves(item, (*path, index))
    else:
        yield path, data
