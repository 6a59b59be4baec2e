"""The JSON schemas for editors: current, and of one mind with the program."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from pydantic import BaseModel, Field

from trainers import plugins as command
from trainers.hookspecs import hookimpl
from trainers.runfile.inheritance import read_run_file
from trainers.runfile.registry import (
    BUILT_IN_PLUGINS,
    Registries,
    load_registries,
    plugin_manager,
)
from trainers.runfile.schema import run_schema
from trainers.runfile.settings import SettingsError, load_run_document
from trainers.runfile.yaml_document import Document, KeyPath, dotted, read

CONFIG = Path(__file__).parents[3] / "config"
FILES = sorted(CONFIG.rglob("*.yaml"))
MODELINE = "# yaml-language-server: $schema="
REWRITE = (
    "python -m trainers.plugins --schema config/schema.json "
    "--sweep-schema config/sweeps/schema.json --reference docs/reference.md"
)
CARTPOLE: dict[str, Any] = {
    "environment": {"type": "gymnasium", "id": "CartPole-v1"},
    "trainer": {"trainer_type": "ppo"},
}


@pytest.fixture(scope="module")
def validator(built_in: Registries) -> Draft202012Validator:
    schema = run_schema(built_in)
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.mark.parametrize(
    ("flag", "file"), [("--schema", "schema.json"), ("--sweep-schema", "sweeps/schema.json")]
)
def test_the_committed_schemas_are_what_the_command_writes(
    built_in: Registries,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    flag: str,
    file: str,
) -> None:
    monkeypatch.setattr("trainers.runfile.registry.load_registries", lambda: built_in)
    assert command.main([flag, str(tmp_path / "schema.json")]) == 0
    written = (tmp_path / "schema.json").read_text()
    assert written == (CONFIG / file).read_text(), f"out of date; write it anew: {REWRITE}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(CONFIG)))
def test_every_file_names_its_schema_first_and_fits_it(path: Path) -> None:
    first = path.read_text().partition("\n")[0]
    assert first.startswith(MODELINE)
    schema = json.loads((path.parent / first.removeprefix(MODELINE)).read_text())
    errors = Draft202012Validator(schema).iter_errors(read(path).data)
    assert [f"{error.json_path}: {error.message}" for error in errors] == []


# -- of one mind with the program ----------------------------------------------------------------


def keys_of(data: Any, path: KeyPath = ()) -> Iterator[KeyPath]:
    """Paths of all keys."""
    pairs = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in pairs:
        if isinstance(data, dict):
            yield (*path, key)
        if isinstance(value, dict | list):
            yield from keys_of(value, (*path, key))


def mistyped(data: Any, path: KeyPath) -> Any:
    """A copy in which one key has a letter too many."""
    changed = part = copy.deepcopy(data)
    for step in path[:-1]:
        part = part[step]
    part[f"{path[-1]}x"] = part.pop(path[-1])
    return changed


def is_taken(data: Any, registries: Registries) -> bool:
    try:
        load_run_document(Document(copy.deepcopy(data), "here"), [], registries)
    except SettingsError:
        return False
    return True


@pytest.mark.parametrize("file", ["run.yaml", "paper/two_cameras.yaml"])
def test_a_mistyped_key_is_refused_by_both(
    validator: Draft202012Validator, built_in: Registries, file: str
) -> None:
    data = read_run_file(CONFIG / file).data
    paths = list(keys_of(data))
    assert len(paths) > 40
    for path in paths:
        wrong = mistyped(data, path)
        assert validator.is_valid(wrong) == is_taken(wrong, built_in), dotted(path)


@pytest.mark.parametrize(
    ("key", "value", "fits"),
    [
        ("trainer.hyperparameters.epsilon", 0.1, True),
        ("trainer.hyperparameters.epsilon", 0, False),
        ("trainer.hyperparameters.epsilon", "0.1", False),
        ("trainer.hyperparameters.learning_rate_schedule", "linear", True),
        ("trainer.hyperparameters.learning_rate_schedule", {"type": "linear"}, True),
        ("trainer.hyperparameters.learning_rate_schedule", "liner", False),
        ("trainer.max_steps", True, False),
        ("trainer.trainer_type", "pop", False),
        ("environment.num_envs", 0, False),
        ("environment.num_envs", 4, True),
        ("environment_parameters", {"wind": 3}, True),
        ("environment_parameters.wind", "strong", False),
        (
            "environment_parameters.wind",
            {"sampler_type": "gaussian", "sampler_parameters": {"mean": 0, "st_dev": 1}},
            True,
        ),
        (
            "environment_parameters.wind",
            {"sampler_type": "gaussian", "sampler_parameters": {"min_value": 0, "st_dev": 1}},
            False,
        ),
        ("rewards", [{"type": "environment", "weight": 2}], True),
        ("rewards", [{"weight": 2}], False),
        ("curriculum", None, True),
        ("seed", -1, False),
        ("device", "cuda", True),
        ("evaluation", {"interval": 1, "stop_when": {"metric": "reward", "at_least": 1}}, True),
        ("Seed", 1, False),
    ],
)
def test_values_are_judged_as_the_program_does(
    validator: Draft202012Validator, built_in: Registries, key: str, value: Any, fits: bool
) -> None:
    document = Document(copy.deepcopy(CARTPOLE), "here")
    document.set(key, value, "here")
    assert validator.is_valid(document.data) == fits
    assert is_taken(document.data, built_in) == fits


def test_keys_of_the_files_own_are_taken(validator: Draft202012Validator) -> None:
    assert validator.is_valid({**CARTPOLE, "x-rates": {"slow": 1e-4}})
    assert not validator.is_valid({**CARTPOLE, "y-rates": {"slow": 1e-4}})


def test_what_extends_another_file_may_leave_anything_out_and_mistype_nothing(
    validator: Draft202012Validator,
) -> None:
    partial = {
        "environment": {"cameras": {"depth": {"width": 32}}},
        "trainer": {"hyperparameters": {"noise": {"sigma": 0.1}}},
    }
    assert not validator.is_valid(partial)
    assert validator.is_valid({"extends": "run.yaml", **partial})
    for path in keys_of(partial):
        wrong = mistyped(partial, path)
        named = "depth" in path[-1:]  # by the user
        assert validator.is_valid({"extends": "run.yaml", **wrong}) == named, dotted(path)


class Their:
    class Settings(BaseModel, frozen=True, extra="forbid"):
        scale_m: float = Field(0.1, gt=0)

    def __call__(self, transition: Any) -> None: ...


class Plugin:
    @hookimpl
    def ventosa_rewards(self) -> dict[str, type]:
        return {"their": Their}


def test_a_plugins_components_are_in_the_schema() -> None:
    with_plugin = load_registries(plugin_manager((*BUILT_IN_PLUGINS, Plugin())))
    validator = Draft202012Validator(run_schema(with_plugin))
    assert validator.is_valid(
        {**CARTPOLE, "rewards": [{"type": "their", "scale_m": 1, "weight": 2}]}
    )
    assert not validator.is_valid({**CARTPOLE, "rewards": [{"type": "their", "scale_m": 0}]})
    assert not validator.is_valid({**CARTPOLE, "rewards": [{"type": "theirs"}]})


# -- sweep files ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "fits"),
    [
        ("trainer.hyperparameters.gamma", True),
        ("trainer.hyperparameters.gama", False),
        ("trainer.hyperparameters.learning_rate_schedule", True),
        ("environment.cameras.depth.width", True),
        ("environment.cameras.depth.widht", False),
        ("environment.kwargs.gravity", True),
        ("rewards.0.weight", True),
        ("rewards.0.gain", True),
        ("encoders.depth.keypoints", True),
        ("evaluation", True),
        ("seed", True),
        ("gamma", False),
    ],
)
def test_dotted_keys_of_sweep_files_are_those_of_run_files(key: str, fits: bool) -> None:
    validator = Draft202012Validator(json.loads((CONFIG / "sweeps/schema.json").read_text()))
    for section in ({"space": {key: {"choice": [1, 2]}}}, {"fixed": {key: 1}}):
        data = {"run": "run.yaml", "space": {"seed": {"choice": [1]}}, **section}
        assert validator.is_valid(data) == fits
