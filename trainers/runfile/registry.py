"""The plugin manager's factory, and one registry per kind of component.

Built-in components are plugins like any other: their modules implement the hooks of
`trainers.hookspecs`. The factory registers them by name, so that a checkout works without being
installed; every other plugin is found through the entry-point group `ventosa`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import pluggy
from pydantic import BaseModel
from torch import nn

from envs.environment import Environment
from trainers import hookspecs
from trainers.common.errors import UserError, suggestion
from trainers.common.origin import Origin, origin_of
from trainers.common.trainer_settings import TrainerSettings
from trainers.loggers.base import Logger

BUILT_IN = "built-in"
BUILT_IN_PLUGINS = (
    "encoders.plugin",
    "rewards.plugin",
    "curricula.plugin",
    "envs.plugin",
    "trainers.plugin",
)
CURRICULUM_METHODS = (
    "initial_state",
    "advance",
    "lesson",
    "lesson_name",
    "parameters",
    "final_parameters",
)
TRAINER_METHODS = ("build_policy", "collect", "update", "state_dict", "load_state_dict")


class PluginError(UserError):
    """A plugin cannot be used; the message names it, its distribution and the reason."""

    def __init__(self, origin: Origin, reason: str) -> None:
        super().__init__(f"{origin}: {reason}")


class UnknownComponentError(LookupError):
    """A name is not registered; the message has the nearest names."""


@dataclass(frozen=True)
class Entry:
    """One registered component."""

    cls: type
    origin: Origin

    @property
    def settings(self) -> type[BaseModel]:
        """The component's settings model."""
        model: type[BaseModel] = self.cls.Settings  # type: ignore[attr-defined]
        return model


@dataclass(frozen=True)
class Registry:
    """The components of one kind, by name."""

    kind: str
    entries: Mapping[str, Entry]

    def get(self, name: str) -> Entry:
        """The component called `name`.

        Raises:
            UnknownComponentError: with the nearest names.
        """
        if name not in self.entries:
            hint = suggestion(name, self.entries)
            raise UnknownComponentError(f"unknown {self.kind} '{name}'; {hint}")
        return self.entries[name]


@dataclass(frozen=True)
class Registries:
    """One registry per kind of component; each field is filled by the hook `ventosa_<field>`."""

    encoders: Registry
    rewards: Registry
    curricula: Registry
    environments: Registry
    trainers: Registry
    loggers: Registry


class PluginManager(pluggy.PluginManager):
    """pluggy's manager, which also knows where each plugin came from."""

    def __init__(self) -> None:
        super().__init__(hookspecs.PROJECT_NAME)
        self.add_hookspecs(hookspecs)
        self.origins: dict[str, Origin] = {}

    def add(self, plugin: object, origin: Origin) -> None:
        """Register a plugin.

        Raises:
            PluginError: it implements no hook, or an unknown one, or is registered already.
        """
        hooks = "the hooks are " + ", ".join(map(hook_name, KINDS))
        try:
            self.register(plugin, name=str(origin))
            self.check_pending()
        except (ValueError, pluggy.PluginValidationError) as error:
            raise PluginError(origin, f"cannot be registered: {error}; {hooks}") from error
        if not self.get_hookcallers(plugin):
            raise PluginError(origin, f"has no function marked with @hookimpl; {hooks}")
        self.origins[str(origin)] = origin


def plugin_manager(built_in: Iterable[str | object] = BUILT_IN_PLUGINS) -> PluginManager:
    """Make a plugin manager with the built-in plugins and the installed ones.

    Args:
        built_in: modules by name, or plugin objects.

    Raises:
        PluginError: a plugin cannot be loaded or registered.
    """
    manager = PluginManager()
    for plugin in built_in:
        if isinstance(plugin, str):
            origin = Origin(plugin, BUILT_IN)
            manager.add(imported(partial(importlib.import_module, plugin), origin), origin)
        else:
            name = getattr(plugin, "__name__", type(plugin).__name__)
            manager.add(plugin, Origin(name, BUILT_IN))
    for point in importlib.metadata.entry_points(group=hookspecs.PROJECT_NAME):
        origin = origin_of(point)
        manager.add(imported(point.load, origin), origin)
    return manager


def imported(load: Callable[[], object], origin: Origin) -> object:
    """Import a plugin; PluginError when that fails."""
    try:
        return load()
    # A module can fail in any way while it is imported.
    except Exception as error:
        reason = f"cannot be imported: {type(error).__name__}: {error}"
        raise PluginError(origin, reason) from error


def load_registries(manager: PluginManager | None = None) -> Registries:
    """Ask every plugin what it provides.

    Args:
        manager: the plugins; by default those of `plugin_manager()`.

    Raises:
        PluginError: a hook fails, a name is registered twice, or a component breaks its contract.
    """
    manager = manager or plugin_manager()
    return Registries(**{field: registry(manager, field) for field in KINDS})


def registry(manager: PluginManager, field: str) -> Registry:
    """Build the registry of one field of `Registries`; errors as `load_registries`."""
    kind, check = KINDS[field]
    entries: dict[str, Entry] = {}
    for implementation in getattr(manager.hook, hook_name(field)).get_hookimpls():
        origin = manager.origins[implementation.plugin_name]
        for name, cls in provided(origin, implementation).items():
            what = f"{kind} '{name}'"
            if name in entries:
                reason = f"{what} is registered already, by {entries[name].origin}"
                raise PluginError(origin, reason)
            broken = contract_breach(cls, RESERVED_KEYS.get(kind, {"type"})) or check(cls)
            if broken:
                raise PluginError(origin, f"{what} breaks its contract: {broken}")
            entries[name] = Entry(cls, origin)
    return Registry(kind, entries)


def provided(origin: Origin, implementation: pluggy.HookImpl) -> Mapping[str, Any]:
    """Call one plugin's implementation of a hook."""
    hook = implementation.function.__name__
    try:
        components = implementation.function()
    # The hook is the plugin's code: it can fail in any way.
    except Exception as error:
        raise PluginError(origin, f"{hook} fails: {type(error).__name__}: {error}") from error
    if not isinstance(components, Mapping):
        reason = f"{hook} returned {components!r}, not a mapping from names to classes"
        raise PluginError(origin, reason)
    for name in components:
        if not isinstance(name, str) or not name:
            raise PluginError(origin, f"{hook} returned the name {name!r}, which is not text")
    return components


def contract_breach(cls: Any, reserved: set[str]) -> str | None:
    """Say how a component breaks what is common to all kinds, or None."""
    if not isinstance(cls, type):
        return f"{cls!r} is not a class"
    model = getattr(cls, "Settings", None)
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        return f"{cls.__name__} has no nested pydantic model Settings"
    if not model.model_config.get("frozen") or model.model_config.get("extra") != "forbid":
        return f'{cls.__name__}.Settings must be declared with frozen=True, extra="forbid"'
    taken = sorted(reserved & set(model.model_fields))
    if taken:
        return f"{cls.__name__}.Settings has the field '{taken[0]}', which the run file needs"
    return None


def encoder_breach(cls: type) -> str | None:
    """Say how an encoder breaks its contract, or None."""
    return None if issubclass(cls, nn.Module) else f"{cls.__name__} is no torch.nn.Module"


def reward_breach(cls: type) -> str | None:
    """Say how a reward breaks its contract, or None."""
    # Not `cls.__call__`: that is the metaclass's, which every class has.
    defined = any("__call__" in vars(base) for base in cls.__mro__)
    if not defined:
        return f"{cls.__name__} is not callable: it has no method __call__"
    declared = getattr(cls, "snapshot", object)
    return None if isinstance(declared, type) else f"{cls.__name__}.snapshot is not a class"


def curriculum_breach(cls: type) -> str | None:
    """Say how a curriculum breaks its contract, or None."""
    return missing_method(cls, CURRICULUM_METHODS)


def environment_breach(cls: type) -> str | None:
    """Say how an environment breaks its contract, or None."""
    fits = issubclass(cls, Environment)
    return None if fits else f"{cls.__name__} is no envs.environment.Environment"


def trainer_breach(cls: type) -> str | None:
    """Say how a trainer breaks its contract, or None."""
    if not issubclass(cls.Settings, TrainerSettings):  # type: ignore[attr-defined]
        return f"{cls.__name__}.Settings is no trainers.algorithms.base.TrainerSettings"
    return missing_method(cls, TRAINER_METHODS)


def logger_breach(cls: type) -> str | None:
    """Say how a logger breaks its contract, or None."""
    fits = issubclass(cls, Logger)
    return None if fits else f"{cls.__name__} is no trainers.loggers.base.Logger"


def missing_method(cls: type, names: Iterable[str]) -> str | None:
    """Say which method a class lacks first, or None."""
    missing = next((name for name in names if not callable(getattr(cls, name, None))), None)
    return f"{cls.__name__} has no method {missing}" if missing else None


KINDS: dict[str, tuple[str, Callable[[type], str | None]]] = {
    "encoders": ("encoder", encoder_breach),
    "rewards": ("reward", reward_breach),
    "curricula": ("curriculum", curriculum_breach),
    "environments": ("environment", environment_breach),
    "trainers": ("trainer", trainer_breach),
    "loggers": ("logger", logger_breach),
}
"""Field of `Registries` -> its kind, and what a class of that kind must keep to."""

RESERVED_KEYS = {"reward": {"type", "weight"}, "trainer": {"trainer_type"}}
"""Keys of the run file that stand beside a component's own settings; otherwise `type` alone."""


def hook_name(field: str) -> str:
    """Name the hook that fills a field of `Registries`."""
    return f"{hookspecs.PROJECT_NAME}_{field}"
