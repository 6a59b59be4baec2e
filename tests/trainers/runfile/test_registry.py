"""The plugin manager and the registries."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from pydantic import BaseModel
from torch import nn

from envs.environment import Environment
from trainers import hookspecs
from trainers import plugins as command
from trainers.common.trainer_settings import TrainerSettings
from trainers.hookspecs import hookimpl
from trainers.loggers.base import Logger
from trainers.runfile import registry as plugins
from trainers.runfile.registry import (
    Origin,
    PluginError,
    Registry,
    UnknownComponentError,
    load_registries,
    plugin_manager,
)

REPOSITORY = Path(__file__).parents[3]


class Empty(BaseModel, frozen=True, extra="forbid"):
    pass


class Loose(BaseModel, frozen=True):
    pass


class Mutable(BaseModel, extra="forbid"):
    pass


class Weighted(BaseModel, frozen=True, extra="forbid"):
    weight: float = 1.0


class Typed(BaseModel, frozen=True, extra="forbid"):
    type: str = "x"


class GoodReward:
    Settings = Empty

    def __call__(self, transition: Any) -> None: ...


class GoodEncoder(nn.Module):
    Settings = Empty


class GoodCurriculum:
    Settings = Empty
    initial_state = advance = lesson = lesson_name = lambda self: None
    parameters = final_parameters = lambda self: None


class GoodEnvironment(Environment):
    Settings: ClassVar[type[BaseModel]] = Empty


class GoodTrainer:
    Settings = TrainerSettings
    build_policy = collect = update = lambda self: None
    state_dict = load_state_dict = lambda self: None


class GoodLogger(Logger):
    Settings: ClassVar[type[BaseModel]] = Empty


GOOD = {
    "encoders": GoodEncoder,
    "rewards": GoodReward,
    "curricula": GoodCurriculum,
    "environments": GoodEnvironment,
    "trainers": GoodTrainer,
    "loggers": GoodLogger,
}


def plugin(name: str = "fake", **offers: Any) -> SimpleNamespace:
    """Make a plugin that offers `encoders={...}` and so on."""
    found = SimpleNamespace(__name__=name)
    for field, components in offers.items():
        # A parameter with a default is the function's own; pluggy passes it nothing.
        hook = hookimpl(lambda offered=components: offered)
        hook.__name__ = f"ventosa_{field}"
        setattr(found, hook.__name__, hook)
    return found


def refused(*fakes: object) -> str:
    with pytest.raises(PluginError) as caught:
        load_registries(plugin_manager(fakes))
    return str(caught.value)


def test_each_hook_fills_its_own_registry() -> None:
    offers = {field: {f"my_{field}": cls} for field, cls in GOOD.items()}
    registries = load_registries(plugin_manager([plugin("fake", **offers)]))
    for field, cls in GOOD.items():
        entry = getattr(registries, field).get(f"my_{field}")
        assert entry.cls is cls
        assert entry.settings is cls.Settings
        assert entry.origin == Origin("fake", "built-in")


def test_components_of_several_plugins_come_together() -> None:
    one = plugin("one", rewards={"a": GoodReward})
    two = plugin("two", rewards={"b": GoodReward})
    rewards = load_registries(plugin_manager([one, two])).rewards
    assert {name: entry.origin.plugin for name, entry in rewards.entries.items()} == {
        "a": "one",
        "b": "two",
    }


def test_the_built_in_plugins_keep_their_own_contract() -> None:
    registries = load_registries(plugin_manager(["encoders.plugin", "rewards.plugin"]))
    assert registries.rewards.get("touch").origin == Origin("rewards.plugin", "built-in")
    assert "conv" in registries.encoders.entries


def test_an_unknown_name_is_answered_with_the_nearest() -> None:
    registry = Registry(
        "reward", load_registries(plugin_manager(["rewards.plugin"])).rewards.entries
    )
    with pytest.raises(UnknownComponentError, match="unknown reward 'tuoch'; did you mean 'touch'"):
        registry.get("tuoch")
    with pytest.raises(UnknownComponentError, match="known: approach, collision, environment,"):
        registry.get("zzz")
    with pytest.raises(UnknownComponentError, match="none is known"):
        Registry("reward", {}).get("touch")


def test_a_name_registered_twice_names_both_plugins() -> None:
    message = refused(
        plugin("one", rewards={"touch": GoodReward}), plugin("two", rewards={"touch": GoodReward})
    )
    assert message == (
        "plugin 'two' (built-in): reward 'touch' is registered already, by plugin 'one' (built-in)"
    )


def test_the_same_name_may_serve_two_kinds() -> None:
    both = plugin(rewards={"x": GoodReward}, trainers={"x": GoodTrainer})
    registries = load_registries(plugin_manager([both]))
    assert registries.rewards.get("x").cls is GoodReward
    assert registries.trainers.get("x").cls is GoodTrainer


def component(name: str, *bases: type, **attributes: Any) -> type:
    return type(name, bases, attributes)


def call(self: Any) -> None: ...


@pytest.mark.parametrize(
    ("field", "cls", "reason"),
    [
        ("rewards", "Near", "'Near' is not a class"),
        ("rewards", GoodReward(), "is not a class"),
        ("rewards", component("Bare", __call__=call), "Bare has no nested pydantic model Settings"),
        (
            "rewards",
            component("Odd", __call__=call, Settings=dict),
            "Odd has no nested pydantic model Settings",
        ),
        ("rewards", component("L", __call__=call, Settings=Loose), 'extra="forbid"'),
        ("rewards", component("M", __call__=call, Settings=Mutable), "frozen=True"),
        ("rewards", component("Still", Settings=Empty), "Still is not callable"),
        (
            "rewards",
            component("Seen", __call__=call, Settings=Empty, snapshot="Walk"),
            "Seen.snapshot is not a class",
        ),
        ("rewards", component("W", __call__=call, Settings=Weighted), "the field 'weight'"),
        ("rewards", component("T", __call__=call, Settings=Typed), "the field 'type'"),
        ("encoders", component("Flat", Settings=Empty), "Flat is no torch.nn.Module"),
        (
            "curricula",
            component("C", Settings=Empty, initial_state=call, advance=call, lesson=call),
            "C has no method lesson_name",
        ),
        (
            "curricula",
            component(
                "C",
                Settings=Empty,
                **dict.fromkeys(("initial_state", "advance", "lesson"), call),
                **dict.fromkeys(("lesson_name", "parameters"), call),
            ),
            "C has no method final_parameters",
        ),
        (
            "environments",
            component("E", Settings=Empty),
            "E is no envs.environment.Environment",
        ),
        ("trainers", component("Bare"), "Bare has no nested pydantic model Settings"),
        (
            "trainers",
            component("T", GoodTrainer, Settings=Empty),
            "T.Settings is no trainers.algorithms.base.TrainerSettings",
        ),
        *(
            ("trainers", component("T", GoodTrainer, **{name: None}), f"T has no method {name}")
            for name in ("build_policy", "collect", "update", "state_dict", "load_state_dict")
        ),
        (
            "loggers",
            component("L", Settings=Empty),
            "L is no trainers.loggers.base.Logger",
        ),
    ],
)
def test_a_broken_contract_is_named(field: str, cls: Any, reason: str) -> None:
    message = refused(plugin("fake", **{field: {"bad": cls}}))
    assert message.startswith("plugin 'fake' (built-in): ")
    assert "'bad' breaks its contract: " in message
    assert reason in message


@pytest.mark.parametrize("returned", [None, ["touch"], GoodReward])
def test_a_hook_must_return_a_mapping(returned: Any) -> None:
    message = refused(plugin(rewards=returned))
    assert "ventosa_rewards returned" in message
    assert "not a mapping" in message


@pytest.mark.parametrize("name", [3, ""])
def test_names_are_text(name: Any) -> None:
    assert f"the name {name!r}" in refused(plugin(rewards={name: GoodReward}))


def test_a_hook_that_raises_is_named() -> None:
    class Failing:
        @hookimpl
        def ventosa_rewards(self) -> dict[str, type]:
            raise RuntimeError("no license server")

    message = refused(Failing())
    assert message == (
        "plugin 'Failing' (built-in): ventosa_rewards fails: RuntimeError: no license server"
    )


def test_an_unknown_hook_is_refused() -> None:
    message = refused(plugin(reward={"near": GoodReward}))
    assert "unknown hook 'ventosa_reward'" in message
    assert "the hooks are ventosa_encoders, ventosa_rewards," in message


def test_a_hook_without_the_marker_is_refused() -> None:
    forgotten = SimpleNamespace(__name__="fake", ventosa_rewards=lambda: {"near": GoodReward})
    assert "plugin 'fake' (built-in): has no function marked with @hookimpl" in refused(forgotten)


def test_a_hook_with_arguments_is_refused() -> None:
    class Greedy:
        @hookimpl
        def ventosa_rewards(self, registry: Any) -> dict[str, type]:
            return {}

    assert "registry" in refused(Greedy())


def test_a_built_in_module_that_is_missing_is_named() -> None:
    message = refused("encoders.nowhere")
    assert message == (
        "plugin 'encoders.nowhere' (built-in): cannot be imported: "
        "ModuleNotFoundError: No module named 'encoders.nowhere'"
    )


def install(
    folder: Path, monkeypatch: pytest.MonkeyPatch, source: str, point: str = "mine = {module}"
) -> None:
    """Lay out a distribution as pip would, with one module."""
    module = f"ventosa_test_{folder.name}"
    monkeypatch.delitem(sys.modules, module, raising=False)
    (folder / f"{module}.py").write_text(source)
    info = folder / "their_dist-2.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-dist\nVersion: 2.5\n")
    (info / "entry_points.txt").write_text(f"[ventosa]\n{point.format(module=module)}\n")
    monkeypatch.syspath_prepend(str(folder))


REWARD_PLUGIN = """
from pydantic import BaseModel
from trainers.hookspecs import hookimpl

class Their:
    class Settings(BaseModel, frozen=True, extra="forbid"):
        scale_m: float = 0.1
    def __call__(self, transition): ...

@hookimpl
def ventosa_rewards():
    return {"their": Their}
"""


def test_an_installed_plugin_is_found_with_its_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, monkeypatch, REWARD_PLUGIN)
    entry = load_registries(plugin_manager(["rewards.plugin"])).rewards.get("their")
    assert entry.origin == Origin("mine", "their-dist 2.5")
    assert list(entry.settings.model_fields) == ["scale_m"]


@pytest.mark.parametrize(
    ("source", "point", "reason"),
    [
        (
            "import not_there_at_all",
            "mine = {module}",
            "No module named 'not_there_at_all'",
        ),
        ("1 / 0", "mine = {module}", "ZeroDivisionError: division by zero"),
        ("def (", "mine = {module}", "SyntaxError"),
        ("", "mine = {module}:Plugin", "has no attribute 'Plugin'"),
        ("", "mine = {module}", "has no function marked with @hookimpl"),
        (
            REWARD_PLUGIN.replace('"their"', '"touch"'),
            "mine = {module}",
            "reward 'touch' is registered already, by plugin 'rewards.plugin' (built-in)",
        ),
        (REWARD_PLUGIN, "mine = {module}\nalso = {module}", "cannot be registered"),
    ],
)
def test_the_failure_of_an_installed_plugin_names_its_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, point: str, reason: str
) -> None:
    install(tmp_path, monkeypatch, source, point)
    message = refused("rewards.plugin")
    assert re.match(r"plugin '(mine|also)' \(their-dist 2\.5\): ", message)
    assert reason in message


def test_the_command_tells_a_plugins_failure(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise PluginError(Origin("mine", "their-dist 2.5"), "is broken")

    monkeypatch.setattr("trainers.runfile.registry.load_registries", fail)
    assert command.main([]) == 2
    assert capsys.readouterr().err == "error: plugin 'mine' (their-dist 2.5): is broken\n"


def test_the_hook_specifications_import_pluggy_alone() -> None:
    source = (REPOSITORY / "trainers/hookspecs.py").read_text()
    imports = set(re.findall(r"^(?:import|from) (\w+)", source, re.MULTILINE))
    assert imports == {"__future__", "pluggy"}


def test_every_hook_is_documented_and_fills_a_registry() -> None:
    hooks = {name for name in vars(hookspecs) if name.startswith("ventosa_")}
    pages = (REPOSITORY / "docs/plugins.md").read_text()
    headings = set(re.findall(r"^### `(ventosa_\w+)`", pages, re.MULTILINE))
    assert headings == hooks
    assert {plugins.hook_name(field) for field in plugins.KINDS} == hooks
    for hook in hooks:
        assert getattr(hookspecs, hook).__doc__


@pytest.mark.parametrize(
    "path",
    [
        "pyproject.toml",
        "ventosa_example/near.py",
        "ventosa_example/mean_pool.py",
        "ventosa_example/plugin.py",
    ],
)
def test_the_documentation_shows_the_example_as_it_is(path: str) -> None:
    example = (REPOSITORY / "examples/ventosa-example-plugin" / path).read_text()
    assert example in (REPOSITORY / "docs/plugins.md").read_text()
