"""Run files of before: keys that have another name now, or are none any more.

A component's `Settings` may say what became of its keys, dotted from the top of its section:

- `renamed_keys`: the former name to the present one;
- `dropped_keys`: the former name to what there is instead, in words.
"""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel

from trainers.runfile.yaml_document import KeyPath, dotted

_logger = logging.getLogger("ventosa")
_ABSENT = object()


def brought_up_to_date(
    section: dict[str, Any], path: KeyPath, settings: type[BaseModel]
) -> tuple[dict[str, Any], dict[KeyPath, str]]:
    """A section with present keys alone, and what became of the former ones, by their paths.

    Where a setting is there under both of its names, the present one holds.

    Args:
        section: a component's settings as they were written; left as it is.
        path: of the section in the run file.
        settings: the component's model.
    """
    dropped: dict[str, str] = getattr(settings, "dropped_keys", {})
    renamed: dict[str, str] = getattr(settings, "renamed_keys", {})
    current, changes = copy.deepcopy(section), {}
    for former in (*dropped, *renamed):
        old = tuple(former.split("."))
        value = _take(current, old)
        if value is _ABSENT:
            continue
        if former in dropped:
            said = f"passed over: {dropped[former]}"
        else:
            new = tuple(renamed[former].split("."))
            how = "read as" if _put(current, new, value) else "passed over for the present"
            said = f"{how} {dotted((*path, *new))}, which is its name now"
        changes[*path, *old] = said
    return current, changes


@functools.cache
def tell(message: str) -> None:
    """Logs a message, once: a command may read a run file several times."""
    _logger.warning("%s", message)


def _take(section: Any, keys: Sequence[str]) -> Any:
    """Removes and returns a value; `_ABSENT` where there is none."""
    *outer, last = keys
    for key in outer:
        section = section.get(key) if isinstance(section, dict) else None
    return section.pop(last, _ABSENT) if isinstance(section, dict) else _ABSENT


def _put(section: Any, keys: Sequence[str], value: Any) -> bool:
    """Sets a value, unless there is one in its place; tells whether it did."""
    *outer, last = keys
    for key in outer:
        section = section.setdefault(key, {}) if isinstance(section, dict) else None
    if not isinstance(section, dict) or last in section:
        return False
    section[last] = value
    return True
