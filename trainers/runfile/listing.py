"""Descriptions of run files' keys and of the registered components, for people and programs."""

from __future__ import annotations

import inspect
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from trainers.common.errors import UserError, suggestion
from trainers.runfile.inheritance import Extending
from trainers.runfile.registry import BUILT_IN, KINDS, Registries
from trainers.runfile.settings import RunFile, Weight
from trainers.runfile.yaml_document import shown

RUN_FILE = "run file"
"""Kind of the row that has the keys which are no component's."""
LONGEST_DEFAULT = 80


def type_name(annotation: Any) -> str:
    """Write a type as its user reads it, such as `float | None` or `'linear' | 'constant'`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return f"{type_name(arguments[0])} {range_text(arguments[1:])}".rstrip()
    if origin is Literal:
        return " | ".join(map(repr, arguments))
    if origin in (typing.Union, types.UnionType):
        return " | ".join(map(type_name, arguments))
    if origin is not None:
        return f"{origin.__name__}[{', '.join(map(type_name, arguments))}]"
    plain = {Ellipsis: "...", types.NoneType: "None"}
    return str(plain.get(annotation) or getattr(annotation, "__name__", annotation))


def range_text(rules: Iterable[Any]) -> str:
    """Write which values a field's rules allow, such as `> 0, <= 1`; empty where none says."""
    said = []
    for rule in rules:
        match rule:
            case Ge(bound):
                said.append(f">= {bound}")
            case Gt(bound):
                said.append(f"> {bound}")
            case Le(bound):
                said.append(f"<= {bound}")
            case Lt(bound):
                said.append(f"< {bound}")
            case MinLen(least):
                said.append("not empty" if least == 1 else f"{least} at least")
            case FieldInfo():
                said.append(range_text(rule.metadata))
    return ", ".join(said)


def settings_rows(model: type[BaseModel], prefix: str = "") -> Iterator[dict[str, Any]]:
    """Describe a model's settings; a nested model's follow with dotted names."""
    for name, field in model.model_fields.items():
        default = None if field.is_required() else field.get_default(call_default_factory=True)
        yield {
            "name": prefix + name,
            "type": type_name(field.annotation),
            "range": range_text(field.metadata),
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


def run_file_row() -> dict[str, Any]:
    """Describe the keys of a run file that are no component's, in the form of `component_rows`."""
    rows = [
        *settings_rows(Extending),
        *settings_rows(RunFile),
        *settings_rows(Weight, "rewards.*."),
    ]
    about = "The keys that are no component's: at the top of the file, and beside a reward's own."
    origin = {"plugin": "", "origin": BUILT_IN}
    return {"kind": RUN_FILE, "name": "", **origin, "description": about, "settings": rows}


def component_rows(registries: Registries) -> list[dict[str, Any]]:
    """Describe every component: kind, name, origin and settings, as plain data."""
    return [
        {
            "kind": found.kind,
            "name": name,
            "plugin": entry.origin.plugin,
            "origin": entry.origin.distribution,
            "description": first_sentence(entry.cls),
            "settings": list(settings_rows(entry.settings)),
        }
        for found in (getattr(registries, field.name) for field in fields(registries))
        for name, entry in sorted(found.entries.items())
    ]


def first_sentence(cls: type) -> str:
    """The first sentence of a class's docstring; empty where it has none of its own."""
    paragraph = inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0]
    return re.split(r"(?<=\.) (?=[A-Z`])", " ".join(paragraph.split()))[0]


def selected(rows: Sequence[Mapping[str, Any]], name: str) -> list[Mapping[str, Any]]:
    """The rows of a kind or a component; or, where there is none, those that have a key, with it.

    Args:
        rows: as `component_rows` has them.
        name: of a kind, in singular or plural, of a component, or of a part of a dotted key.

    Raises:
        UserError: nothing has that name; with the nearest ones.
    """
    plurals = {kind: plural for plural, (kind, _) in KINDS.items()}
    if found := [
        row for row in rows if name in (row["kind"], plurals.get(row["kind"]), row["name"])
    ]:
        return found
    for row in rows:
        settings = [s for s in row["settings"] if name in (s["name"], *_parts(s))]
        if settings:
            found.append({**row, "settings": settings})
    if not found:
        known = {row[key] for row in rows for key in ("kind", "name")}
        keys = {part for row in rows for setting in row["settings"] for part in _parts(setting)}
        hint = suggestion(name, known | keys)
        raise UserError(f"no kind, component or key is called '{name}'; {hint}")
    return found


def _parts(setting: Mapping[str, Any]) -> list[str]:
    return [part for part in setting["name"].split(".") if part != "*"]


def heading(row: Mapping[str, Any]) -> str:
    """Write what a row describes: `trainer ppo (built-in)`."""
    return f"{row['kind']} {row['name']} ({row['origin']})" if row["name"] else row["kind"]


def value_text(setting: Mapping[str, Any]) -> str:
    """Write a setting's type, range and default: `int (>= 1) = 8`."""
    allowed = f" ({setting['range']})" if setting["range"] else ""
    default = ", required" if setting["required"] else f" = {default_text(setting)}"
    return f"{setting['type']}{allowed}{default}"


def default_text(setting: Mapping[str, Any]) -> str:
    """Write a setting's default as it would stand in the run file, cut where it is long."""
    return shown(setting["default"], LONGEST_DEFAULT)


def print_plain(rows: Iterable[Mapping[str, Any]]) -> None:
    """Print components for a pipe or a file: a line each, their settings indented below."""
    for row in rows:
        print(heading(row))
        for setting in row["settings"]:
            print(f"  {setting['name']}: {value_text(setting)}  {setting['description']}".rstrip())


def print_wrapped(rows: Iterable[Mapping[str, Any]], console: Console) -> None:
    """Print components for a terminal, whatever its width: descriptions below their keys."""
    for row in rows:
        # As plain text: a type such as `list[int]` is no markup.
        console.print(Text(heading(row), style="bold"))
        console.print(Padding(Text(row["description"]), (0, 0, 0, 2)))
        for setting in row["settings"]:
            facts = Text.assemble((setting["name"], "cyan"), ": ", value_text(setting))
            console.print(Padding(facts, (0, 0, 0, 2)))
            if setting["description"]:
                console.print(Padding(Text(setting["description"]), (0, 0, 0, 6)))
        console.print()
