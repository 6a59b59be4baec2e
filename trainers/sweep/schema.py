"""JSON schema of sweep files; see `trainers.runfile.schema`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from trainers.runfile.listing import component_rows, run_file_row
from trainers.runfile.registry import Registries
from trainers.runfile.schema import DIALECT
from trainers.sweep.plan import SweepSettings

SECTIONS = {
    "encoder": "encoders.*.",
    "reward": "rewards.*.",
    "curriculum": "curriculum.",
    "environment": "environment.",
    "trainer": "trainer.",
}
"""Kind of component -> where its settings stand in a run file."""


def sweep_schema(registries: Registries) -> dict[str, Any]:
    """The schema of sweep files, whose `fixed` and `space` have dotted keys of run files."""
    schema = SweepSettings.model_json_schema()
    keys = sorted(set(dotted_keys(registries)))
    names = [key for key in keys if "*" not in key]
    patterns = [re.escape(key).replace(r"\*", "[^.]+") for key in keys if "*" in key]
    schema["$defs"]["key"] = {
        "description": "A dotted key of the run file.",
        "anyOf": [{"enum": names}, {"pattern": f"^({'|'.join(patterns)})$"}],
    }
    for section in ("fixed", "space"):
        schema["properties"][section]["propertyNames"] = {"$ref": "#/$defs/key"}
    return {"$schema": DIALECT, **schema}


def dotted_keys(registries: Registries) -> Iterator[str]:
    """Every key that a run file may have, with `*` for what it names itself."""
    for row in (run_file_row(), *component_rows(registries)):
        section = SECTIONS.get(row["kind"], "")
        for setting in row["settings"]:
            yield section + setting["name"]
            if setting["type"].startswith("dict["):
                yield f"{section}{setting['name']}.*"
