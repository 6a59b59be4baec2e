"""Validates plain data with a pydantic model, and says what is wrong in the user's terms."""

from __future__ import annotations

import json
import math
import re
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from trainers.common.errors import suggestion
from trainers.runfile.foreign_keys import way_out
from trainers.runfile.yaml_document import KeyPath, dotted, shown

Model = TypeVar("Model", bound=BaseModel)

PLAIN_WORDS = {
    "bool_type": "should be true or false",
    "dict_type": "should be a mapping (key: value)",
    "float_type": "should be a number",
    "int_type": "should be a whole number",
    "list_type": "should be a list",
    "model_type": "should be a mapping (key: value)",
    "string_type": "should be text",
    "tuple_type": "should be a list",
}
"""pydantic's error types -> what to say instead of its words, which are Python's and JSON's."""

PYDANTIC_EXTRAS = r"^\w+ (?=should )| after validation, not \d+$"
"""Parts to leave out of pydantic's other messages: "Input should be" and the like."""

MAX_FLOAT32 = (2.0 - 2.0**-23) * 2.0**127
"""Largest number of networks and observations, 3.4e38."""


class InvalidError(Exception):
    """Data does not fit a model.

    Attributes:
        problems: path within the data, and message.
    """

    def __init__(self, problems: list[tuple[KeyPath, str]]) -> None:
        super().__init__("; ".join(f"{dotted(path)}: {message}" for path, message in problems))
        self.problems = problems


def validate(model: type[Model], data: Any, beside: tuple[str, ...] = ()) -> Model:
    """Validate plain data strictly: no number from text, no integer from 5.0 or true.

    Args:
        model: what the data must fit.
        data: as YAML has it.
        beside: keys that are allowed beside the model's own, for the hints.

    Raises:
        InvalidError: with every problem found.
    """
    try:
        # As JSON: there, strict still takes an integer for a float and a list for a tuple.
        return model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        details = [item for item in error.errors(include_url=False) if not was_shortened(item)]
    messages: dict[KeyPath, list[str]] = {}
    paths = [data_path(item, data) for item in details]
    for path, item in zip(paths, details, strict=True):
        # A value that may be this or that is refused once for each; a problem inside the value
        # tells which one was meant.
        alternative = len(item["loc"]) > len(path)
        if alternative and any(other != path == other[: len(path)] for other in paths):
            continue
        messages.setdefault(path, []).append(message(model, data, path, item, beside))
    raise InvalidError(
        [(path, "; or ".join(dict.fromkeys(said))) for path, said in messages.items()]
    )


def was_shortened(item: ErrorDetails) -> bool:
    """Whether a list is only too short once pydantic left out the items that are told of anyway."""
    return item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]


def data_path(item: ErrorDetails, data: Any) -> KeyPath:
    """Find the path of an error in the data: pydantic's has the names of alternatives in it."""
    path: KeyPath = ()
    last = len(item["loc"]) - 1
    for position, step in enumerate(item["loc"]):
        if has(data, step):
            data = data[step]
            path = (*path, step)
        elif position == last and item["type"] == "missing":
            path = (*path, step)
    if item["type"] == "union_tag_invalid":
        path = (*path, item["ctx"]["discriminator"].strip("'"))
    return path


def message(
    model: type[BaseModel], data: Any, path: KeyPath, item: ErrorDetails, beside: tuple[str, ...]
) -> str:
    """Say what is wrong, what was written, and what is allowed."""
    context = item.get("ctx", {})
    match item["type"]:
        case "extra_forbidden":
            owners = models_at(model, path[:-1], data)
            known = [name for owner in owners for name in owner.model_fields]
            known.extend(beside if len(path) == 1 else ())
            hint = way_out(path[-1:]) or suggestion(str(path[-1]), known)
            said = f"unknown key; {hint}"
        case "missing":
            said = f"missing: {missing(models_at(model, path[:-1], data), path[-1])}"
        case "value_error":
            said = str(context["error"])
        case "union_tag_invalid":
            tag, expected = str(context["tag"]), str(context["expected_tags"])
            hint = suggestion(tag, [name.strip("'") for name in expected.split(", ")])
            said = f"unknown name '{tag}'; {hint}"
        case "union_tag_not_found":
            needed = f"needs the key {context['discriminator']}, which says what it is"
            said = way_out(item["input"]) or needed
        case kind:
            plain = PLAIN_WORDS.get(kind, re.sub(PYDANTIC_EXTRAS, "", item["msg"]))
            said = f"{plain}, not {shown(item['input'])}"
    return said


def missing(owners: list[type[BaseModel]], step: str | int) -> str:
    """Say what a missing key is for, or where a list ends too early."""
    if isinstance(step, int):
        return f"the list has {step} items, which is too few"
    fields = [owner.model_fields[step] for owner in owners if step in owner.model_fields]
    return next((field.description for field in fields if field.description), "it is required")


def models_at(annotation: Any, path: KeyPath, data: Any) -> list[type[BaseModel]]:
    """The models that describe `path`, by the type annotations from `annotation` on.

    Where several could, those stay whose `Literal` fields have the values written in the data.
    """
    alternatives = typing.get_origin(annotation) in (Annotated, typing.Union, types.UnionType)
    parts = typing.get_args(annotation)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if not fits_literals(annotation, data):
            return []
        if not path:
            return [annotation]
        field = annotation.model_fields.get(str(path[0]))
        parts = (field.annotation,) if field else ()
    if not alternatives:
        if not path:
            return []
        data = data[path[0]] if has(data, path[0]) else None
        path = path[1:]
    return [found for part in parts for found in models_at(part, path, data)]


def has(data: Any, step: str | int) -> bool:
    """Tell whether `data` is a mapping with that key, or a list with that item."""
    if isinstance(data, list):
        return isinstance(step, int) and step < len(data)
    return isinstance(data, dict) and step in data


def fits_literals(model: type[BaseModel], data: Any) -> bool:
    """Tell whether the data has the values that the model's `Literal` fields ask for."""
    if not isinstance(data, Mapping):
        return True
    return all(
        data[name] in typing.get_args(field.annotation)
        for name, field in model.model_fields.items()
        if typing.get_origin(field.annotation) is Literal and name in data
    )


def float_problems(data: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, str]]:
    """What is wrong with numbers that are none, or that networks can't calculate with."""
    if isinstance(data, dict):
        for key, value in data.items():
            yield from float_problems(value, (*path, key))
    elif isinstance(data, list):
        for index, value in enumerate(data):
            yield from float_problems(value, (*path, index))
    elif isinstance(data, float) and not math.isfinite(data):
        yield path, "should be a finite number"
    elif isinstance(data, float) and abs(data) > MAX_FLOAT32:
        yield path, f"should be within +-{MAX_FLOAT32:.2g}, not {shown(data)}"
