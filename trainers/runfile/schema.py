"""JSON schema of run files, by which editors complete and check them.

It is made of the models that run files are validated with. What depends on several values, such as
a range's order, is left to `trainers.learn`.
"""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import Any, Literal

from pydantic import BaseModel, Field, create_model
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from trainers.runfile.inheritance import EXTENDS, OWN_KEYS, Extending
from trainers.runfile.listing import first_sentence
from trainers.runfile.registry import Registries, Registry
from trainers.runfile.settings import TRAINER_TYPE_KEY, TYPE_KEY, RunFile, Weight

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class _PartialSchema(GenerateJsonSchema):
    """A schema in which no key is required: what a file leaves out may be its base's."""

    def field_is_required(self, field: Any, total: bool) -> bool:
        return False

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> JsonSchemaValue:
        # Without its tag a part of a section may fit several; `discriminator` is OpenAPI's.
        return {"anyOf": super().tagged_union_schema(schema)["oneOf"]}


def run_schema(registries: Registries) -> dict[str, Any]:
    """The schema of run files that name these components.

    Every section is one of its kind's components, told apart by its `type`. Keys are required in
    files that extend no other, and there only those which say what a section is.
    """
    schema = run_file_model(registries).model_json_schema(schema_generator=_PartialSchema)
    return {
        "$schema": DIALECT,
        **schema,
        "patternProperties": {f"^{OWN_KEYS}": {"description": "The file's own, for anchors."}},
        "if": {"not": {"required": [EXTENDS]}},
        "then": {
            "required": [
                name for name, field in RunFile.model_fields.items() if field.is_required()
            ],
            "properties": {
                "environment": _requiring(TYPE_KEY),
                "rewards": {"items": _requiring(TYPE_KEY)},
                "encoders": {"additionalProperties": _requiring(TYPE_KEY)},
                "curriculum": _requiring(TYPE_KEY),
                "trainer": _requiring(TRAINER_TYPE_KEY),
            },
        },
    }


def run_file_model(registries: Registries) -> type[BaseModel]:
    """A model of whole run files, with the components' own settings in their sections."""
    sections = {
        "environment": _any_of(registries.environments),
        "rewards": list[_any_of(registries.rewards, Weight)] | None,  # type: ignore[misc]
        "encoders": dict[str, _any_of(registries.encoders)] | None,  # type: ignore[misc]
        "curriculum": _any_of(registries.curricula) | None,
        "trainer": _any_of(registries.trainers, type_key=TRAINER_TYPE_KEY),
    }
    known = {name: RunFile.model_fields[name] for name in sections}
    typed: dict[str, Any] = {
        name: (sections[name], Field(field.default, description=field.description))
        for name, field in known.items()
    }
    return create_model("RunFile", __base__=(Extending, RunFile), __doc__=RunFile.__doc__, **typed)


def _any_of(registry: Registry, *beside: type[BaseModel], type_key: str = TYPE_KEY) -> Any:
    """The settings of each component of a kind, with the key that names it: a union of models."""
    models: list[Any] = []
    for name, entry in sorted(registry.entries.items()):
        about = first_sentence(entry.cls)
        key: dict[str, Any] = {type_key: (Literal[name], Field(description=about))}
        bases = (entry.settings, *beside)
        models.append(create_model(f"{registry.kind} {name}", __base__=bases, __doc__=about, **key))
    return reduce(or_, models)


def _requiring(key: str) -> dict[str, Any]:
    return {"required": [key]}
