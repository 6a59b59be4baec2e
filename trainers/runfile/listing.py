"""Descriptions of the registered components, for people and for programs."""

from __future__ import annotations

import json
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import BaseModel
from pydantic_core import to_jsonable_python
from rich.console import Console
from rich.table import Table
from rich.text import Text

from trainers.runfile.registry import Registries


def type_name(annotation: Any) -> str:
    """Write a type as its user reads it, such as `float | None` or `'linear' | 'constant'`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return type_name(arguments[0])
    if origin is Literal:
        return " | ".join(map(repr, arguments))
    if origin in (typing.Union, types.UnionType):
        return " | ".join(map(type_name, arguments))
    if origin is not None:
        return f"{origin.__name__}[{', '.join(map(type_name, arguments))}]"
    plain = {Ellipsis: "...", types.NoneType: "None"}
    return str(plain.get(annotation) or getattr(annotation, "__name__", annotation))


def settings_rows(model: type[BaseModel], prefix: str = "") -> Iterator[dict[str, Any]]:
    """Describe a model's settings; a nested model's follow with dotted names."""
    for name, field in model.model_fields.items():
        default = None if field.is_required() else field.get_default(call_default_factory=True)
        yield {
            "name": prefix + name,
            "type": type_name(field.annotation),
            "required": field.is_required(),
            "default": to_jsonable_python(default, fallback=str),
            "description": field.description or "",
        }
        for within, nested in nested_models(field.annotation):
            yield from settings_rows(nested, f"{prefix}{name}{within}.")


def nested_models(annotation: Any, within: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Find the models that a type can hold, each with `.*` for every container around it."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield within, annotation
        return
    container = typing.get_origin(annotation) not in (Annotated, typing.Union, types.UnionType)
    for part in typing.get_args(annotation):
        yield from nested_models(part, f"{within}.*" if container else within)


def component_rows(registries: Registries) -> list[dict[str, Any]]:
    """Describe every component: kind, name, origin and settings, as plain data."""
    return [
        {
            "kind": found.kind,
            "name": name,
            "plugin": entry.origin.plugin,
            "origin": entry.origin.distribution,
            "settings": list(settings_rows(entry.settings)),
        }
        for found in (getattr(registries, field.name) for field in fields(registries))
        for name, entry in sorted(found.entries.items())
    ]


def default_text(row: Mapping[str, Any]) -> str:
    """Write a setting's default as it would stand in the run file."""
    return "required" if row["required"] else json.dumps(row["default"], ensure_ascii=False)


def print_plain(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print components for a pipe or a file: a line each, their settings indented below."""
    for row in rows:
        print(f"{row['kind']} {row['name']} ({row['origin']})")
        for setting in row["settings"]:
            print(
                f"  {setting['name']}: {setting['type']} = {default_text(setting)}"
                f"  {setting['description']}".rstrip()
            )


def print_tables(rows: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print components for a terminal, a table each."""
    for row in rows:
        table = Table(title=f"{row['kind']} {row['name']} ({row['origin']})", title_justify="left")
        for heading in ("setting", "type", "default", "description"):
            table.add_column(heading)
        for setting in row["settings"]:
            # As plain text: a type such as `list[int]` is no markup.
            cells = (setting["name"], setting["type"], default_text(setting))
            table.add_row(*map(Text, (*cells, setting["description"])))
        console.print(table)
