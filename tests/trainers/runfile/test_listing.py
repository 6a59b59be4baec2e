"""What can be set, as people read it: types, ranges, defaults, and what a name selects."""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, Field

from trainers import plugins as command
from trainers.common.errors import UserError
from trainers.hookspecs import hookimpl
from trainers.runfile.listing import (
    component_rows,
    first_sentence,
    run_file_row,
    selected,
    type_name,
)
from trainers.runfile.registry import Registries, load_registries, plugin_manager


class Inner(BaseModel, frozen=True, extra="forbid"):
    rate: float = Field(1e-3, gt=0, le=1, description="How fast.")


class Described(BaseModel, frozen=True, extra="forbid"):
    count: int = Field(ge=1, description="How many.")
    inner: Inner = Field(Inner(), description="The inside.")
    memory: Inner | None = Field(None, description="Or none.")
    many: dict[str, Inner] = Field({}, description="Any number.")
    sizes: tuple[Annotated[int, Field(gt=0)], ...] = Field(
        (1, 2), min_length=1, description="The sizes."
    )


class Mine:
    """A reward by al. et al. 2015 (v . n). It has settings of all kinds."""

    Settings = Described

    def __call__(self, transition: Any) -> None: ...


class Plugin:
    @hookimpl
    def ventosa_rewards(self) -> dict[str, type]:
        return {"mine": Mine}


@pytest.fixture(scope="module")
def mine() -> Registries:
    return load_registries(plugin_manager([Plugin()]))


def test_the_listing_tells_kind_name_origin_and_settings(mine: Registries) -> None:
    (row,) = component_rows(mine)
    settings = {setting.pop("name"): setting for setting in row.pop("settings")}
    assert row == {
        "kind": "reward",
        "name": "mine",
        "plugin": "Plugin",
        "origin": "built-in",
        "description": "A reward by al. et al. 2015 (v . n).",
    }
    rate = {
        "type": "float",
        "range": "> 0, <= 1",
        "required": False,
        "default": 0.001,
        "description": "How fast.",
    }
    facts = {
        "count": ("int", ">= 1", True, None, "How many."),
        "inner": ("Inner", "", False, {"rate": 0.001}, "The inside."),
        "memory": ("Inner | None", "", False, None, "Or none."),
        "many": ("dict[str, Inner]", "", False, {}, "Any number."),
        "sizes": ("tuple[int > 0, ...]", "not empty", False, [1, 2], "The sizes."),
    }
    assert settings == {
        **{name: dict(zip(rate, fact, strict=True)) for name, fact in facts.items()},
        "inner.rate": rate,
        "memory.rate": rate,
        "many.*.rate": rate,
    }


@pytest.mark.parametrize(
    ("annotation", "text"),
    [
        (int, "int"),
        (float | None, "float | None"),
        (Literal["a", "b"], "'a' | 'b'"),
        (dict[str, Annotated[int, "positive"]], "dict[str, int]"),
        (list[tuple[float, float]], "list[tuple[float, float]]"),
    ],
)
def test_types_are_written_short(annotation: Any, text: str) -> None:
    assert type_name(annotation) == text


def test_a_class_without_words_of_its_own_has_no_sentence() -> None:
    assert first_sentence(type("Silent", (Mine,), {})) == ""


def test_the_run_files_own_keys_are_listed(registries: Registries) -> None:
    names = {setting["name"] for setting in run_file_row()["settings"]}
    assert {"extends", "seed", "device", "environment_parameters", "rewards.*.weight"} <= names
    assert {"evaluation.interval", "evaluation.stop_when.at_least"} <= names


# -- what a name selects -------------------------------------------------------------------------


def found(registries: Registries, name: str) -> dict[str, list[str]]:
    rows = selected([run_file_row(), *component_rows(registries)], name)
    return {row["name"]: [setting["name"] for setting in row["settings"]] for row in rows}


def test_a_name_selects_a_kind_a_component_or_a_key(registries: Registries) -> None:
    trainers = {"ddpg", "ppo", "trpo"}
    assert trainers <= found(registries, "trainer").keys() == found(registries, "trainers").keys()
    (ppo,) = found(registries, "ppo").values()
    assert {"max_steps", "hyperparameters.epsilon"} <= set(ppo)
    assert found(registries, "seed") == {"": ["evaluation.seed", "seed"]}
    assert found(registries, "kl_penalty") == {"ppo": ["hyperparameters.kl_penalty"]}
    assert found(registries, "hyperparameters.epsilon")["ppo"] == ["hyperparameters.epsilon"]


def test_a_name_of_nothing_is_told_with_the_nearest(registries: Registries) -> None:
    with pytest.raises(UserError, match=r"called 'lerning_rate'; did you mean 'learning_rate'"):
        found(registries, "lerning_rate")


# -- the command ---------------------------------------------------------------------------------


@pytest.fixture
def _listed(mine: Registries, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainers.runfile.registry.load_registries", lambda: mine)


@pytest.mark.usefixtures("_listed")
def test_the_command_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--json"]) == 0
    run_file, row = json.loads(capsys.readouterr().out)
    assert (row["kind"], row["name"], len(row["settings"])) == ("reward", "mine", 8)
    assert run_file["kind"] == "run file"


@pytest.mark.usefixtures("_listed")
def test_the_command_prints_plain_text_to_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["mine"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "reward mine (built-in)"
    assert "  count: int (>= 1), required  How many." in lines
    assert "  sizes: tuple[int > 0, ...] (not empty) = [1, 2]  The sizes." in lines


@pytest.mark.parametrize("width", [40, 80])
def test_on_a_terminal_everything_fits_and_nothing_is_cut(
    registries: Registries,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    width: int,
) -> None:
    monkeypatch.setattr("trainers.runfile.registry.load_registries", lambda: registries)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", str(width))
    assert command.main([]) == 0
    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(map(len, printed.splitlines())) <= width
    joined = "".join(printed.split())
    for row in [run_file_row(), *component_rows(registries)]:
        for setting in row["settings"]:
            assert "".join(f"{setting['name']}:{setting['type']}".split()) in joined
            assert "".join(setting["description"].split()) in joined
