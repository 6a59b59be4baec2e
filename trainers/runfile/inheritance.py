"""Run files that name another as their base: `extends: base.yaml`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from trainers.runfile.yaml_document import (
    Document,
    KeyPath,
    Problem,
    SettingsError,
    read,
    shown,
)

EXTENDS = "extends"
OWN_KEYS = "x-"
"""Beginning of keys at the top that are for the user's own use, for anchors above all."""
TYPE_KEYS = ("type", "trainer_type")


class Extending(BaseModel, frozen=True, extra="forbid"):
    """What a run file has beside its sections, until its base is read."""

    extends: str | None = Field(
        None,
        min_length=1,
        description="Another run file, as seen from this one: what it says holds where this one "
        "says nothing.",
    )


def read_run_file(path: Path) -> Document:
    """Reads a run file and what it extends; that key and those with `x-` are not in the result.

    A mapping adds to that of the base and overrides it key by key. Anything else takes the place of
    what the base has: a number, a list, `null`, and a mapping whose `type` is another, because the
    base's keys beside it are that other's.

    Raises:
        SettingsError: see `read`; or a base is not there, or the files extend each other in a
            circle.
    """
    return _read(path, ())


def _read(path: Path, extending: tuple[Path, ...]) -> Document:
    document = read(path)
    for key in [key for key in document.data if key.startswith(OWN_KEYS)]:
        del document.data[key]
    if EXTENDS not in document.data:
        return document
    place = document.where((EXTENDS,))
    base = _base(document.data.pop(EXTENDS), path, place)
    chain = (*extending, path)
    if any(base.samefile(known) for known in chain):
        circle = " -> ".join(map(str, (*chain, base)))
        raise SettingsError([Problem(place, (EXTENDS,), f"goes round in a circle: {circle}")])
    return _extended(_read(base, chain), document)


def _base(name: Any, path: Path, place: str) -> Path:
    if not (isinstance(name, str) and name):
        message = f"must be the name of a run file, not {shown(name)}"
        raise SettingsError([Problem(place, (EXTENDS,), message)])
    base = path.parent / name
    if not base.is_file():
        message = f"there is no file {base}; write it as seen from {path.parent}"
        raise SettingsError([Problem(place, (EXTENDS,), message)])
    return base


def _extended(base: Document, document: Document) -> Document:
    """The base with what a run file says over it, and where each of it was written."""
    places = dict(base.places)
    data = _merged(base.data, document.data, (), places)
    del document.places[EXTENDS,]
    return Document(data, document.origin, places | document.places)


def _merged(base: Any, own: Any, path: KeyPath, places: dict[KeyPath, str]) -> Any:
    """What is own over what is the base's; removes places of what is no longer there."""
    if _adds_to(base, own):
        return base | {
            key: _merged(base.get(key), value, (*path, key), places) for key, value in own.items()
        }
    for known in [known for known in places if known[: len(path)] == path]:
        del places[known]
    return own


def _adds_to(base: Any, own: Any) -> bool:
    if not (isinstance(base, dict) and isinstance(own, dict)):
        return False
    return all(own.get(key, base.get(key)) == base.get(key) for key in TYPE_KEYS)
