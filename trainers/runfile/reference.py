"""The page docs/reference.md: every key and every TensorBoard tag, from what declares them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from typing import Any

from pydantic import BaseModel

from trainers.runfile.listing import (
    component_rows,
    default_text,
    run_file_row,
    settings_rows,
)
from trainers.runfile.registry import Entry, Registries

COMMAND = "python -m trainers.plugins --reference docs/reference.md"
ABOUT_TAGS = (
    "Written every `summary_freq` steps of all environments together. Statistics of updates and of "
    "finished episodes are means over those since the summary before."
)
TAG_HEADINGS = ("tag", "what it says")
INTRODUCTION = f"""# Reference

<!-- Written by `{COMMAND}`: change the models' descriptions, not this page. -->

All keys of run files and sweep files, and all TensorBoard tags. A section names its component by
`type`, the trainer's by `trainer_type`; the keys beside that are the component's own, dotted from
there. `*` stands for a name, or for an item of a list. `python -m trainers.plugins NAME` looks up a
key, a component or a kind, those of installed plugins included.
"""


def reference(
    registries: Registries, sweep: type[BaseModel], tags: Mapping[str, str]
) -> Iterator[str]:
    """Lines of the page, in Markdown.

    Args:
        registries: the components.
        sweep: the model of sweep files.
        tags: what every run logs, by TensorBoard tag.
    """
    yield INTRODUCTION
    top = run_file_row()
    yield f"## Run file\n\n{top['description']}\n"
    yield from _keys(top["settings"])
    rows = component_rows(registries)
    for field in fields(registries):
        found = getattr(registries, field.name)
        yield f"\n## {field.name.title()}"
        for row in (row for row in rows if row["kind"] == found.kind):
            yield from _component(row, found.entries[row["name"]])
    yield f"\n## Sweep file\n\n{sweep.__doc__}\n"
    yield from _keys(settings_rows(sweep))
    yield f"\n## TensorBoard\n\n{ABOUT_TAGS}\n"
    yield from _table(TAG_HEADINGS, tags.items())
    for found in (registries.trainers, registries.environments):
        for name, entry in sorted(found.entries.items()):
            if own := getattr(entry.cls, "tags", {}):
                yield f"\nOf the {found.kind} `{name}`:\n"
                yield from _table(TAG_HEADINGS, own.items())


def _component(row: Mapping[str, Any], entry: Entry) -> Iterator[str]:
    yield f"\n### `{row['name']}`\n\n{row['description']}\n"
    if names := sorted(getattr(entry.cls, "parameter_names", ())):
        yield f"Environment parameters: {', '.join(f'`{name}`' for name in names)}.\n"
    if row["settings"]:
        yield from _keys(row["settings"])


def _keys(settings: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """A table of keys, their types with what is allowed, defaults and descriptions."""
    yield from _table(
        ("key", "type", "default", "what it is"),
        (
            (
                setting["name"],
                ", ".join(filter(None, (setting["type"], setting["range"]))),
                "" if setting["required"] else default_text(setting),
                ("Required. " if setting["required"] else "") + setting["description"],
            )
            for setting in settings
        ),
    )


def _table(headings: tuple[str, ...], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """A table whose last column is text, and the others code."""
    yield f"| {' | '.join(headings)} |"
    yield "|---" * len(headings) + "|"
    for *cells, text in rows:
        code = [f"`{cell}`" if cell else "" for cell in cells]
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in (*code, text)) + " |"
