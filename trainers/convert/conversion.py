"""A run file made of a trainer configuration of ML-Agents."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from trainers.convert.account import Account
from trainers.convert.keys import BEHAVIOR, DEFAULTS, FLOORS, LESSON, TOP, Fate, Kept, fate
from trainers.convert.parameters import SECTION, Parameters, convert_parameters
from trainers.convert.source import BEHAVIORS, DEFAULT_SETTINGS, Source, leaves
from trainers.runfile.registry import Entry, Registries, UnknownComponentError
from trainers.runfile.settings import load_run_document
from trainers.runfile.validation import models_at
from trainers.runfile.yaml_document import Document, KeyPath, SettingsError, dump, shown

PLACEHOLDER = "FILL-IN-v0"
"""Id of no environment, in the place of Unity's executable."""
SECTIONS = ("environment", "rewards", "curriculum", SECTION, "trainer", "seed", "device")
"""Of a run file, in their order."""
TEAMS = (
    "; it trains groups of agents together, which no trainer of ventosa's does: with "
    "`trainer_type: ppo` each agent learns by itself"
)
OTHER_WAYS = {
    "sac": "; examples/ventosa-sac-plugin of ventosa's repository brings one",
    "poca": TEAMS,
    "coma": TEAMS,
}
"""Trainers of ML-Agents that ventosa doesn't bring along, and the way out."""


def convert(path: Path, behavior: str | None, env_id: str | None, registries: Registries) -> str:
    """A run file, with what became of the configuration's keys as comments.

    Args:
        path: the trainer configuration.
        behavior: which of its behaviors; None: the only one.
        env_id: of the gymnasium environment; None: to be filled in.
        registries: the components that can be named.

    Raises:
        UserError: the file is not ML-Agents', has no such behavior, or says what can't be.
    """
    source = Source.read(path)
    conversion = _Conversion(source, source.choose(behavior), registries)
    run = conversion.run_file(env_id or PLACEHOLDER)
    load_run_document(run, [], registries)
    title = [f"Made of {path}, behavior {conversion.behavior}, by `python -m trainers.convert`."]
    if env_id is None:
        title.append(
            "Fill in environment.id, the gymnasium environment in the place of Unity's executable: "
            "docs/coming_from.md."
        )
    return f"{conversion.account.comments(*title)}\n{dump(run.data)}"


class _Conversion:
    """A behavior on its way to a run file, and the account of it."""

    def __init__(self, source: Source, behavior: str, registries: Registries):
        self._source, self.behavior = source, behavior
        self._run = Document({}, source.document.origin)
        self.account = Account((BEHAVIORS, behavior))
        self._trainer, entry = self._find_trainer(registries)
        self._settings = entry.settings

    def run_file(self, env_id: str) -> Document:
        """The run file, of which each part was written where it was in the configuration."""
        self._put("environment.type", "gymnasium", ())
        self._put("environment.id", env_id, ())
        self._put("trainer.trainer_type", self._trainer, ())
        for path, value, what in self._written():
            self._settle(path, value, what)
        self._put_parameters(convert_parameters(self._source, self.behavior))
        self._add_defaults()
        self._add_floors()
        data = self._run.data
        self._run.data = {name: data[name] for name in SECTIONS if name in data}
        return self._run

    def _find_trainer(self, registries: Registries) -> tuple[str, Entry]:
        path: tuple[str, ...] = (BEHAVIORS, self.behavior)
        if "trainer_type" not in self._source.section(*path):
            path = (DEFAULT_SETTINGS,)
        name = str(self._source.section(*path).get("trainer_type", "ppo"))
        try:
            return name, registries.trainers.get(name)
        except UnknownComponentError as error:
            message = f"{error}{OTHER_WAYS.get(name, '')}"
            raise SettingsError([self._source.problem((*path, "trainer_type"), message)]) from error

    def _written(self) -> Iterator[tuple[KeyPath, Any, Fate]]:
        """Path, value and fate of all that is written, but for the environment parameters."""
        own = dict(leaves(self._source.section(BEHAVIORS, self.behavior)))
        for path, value in leaves(self._source.section(DEFAULT_SETTINGS)):
            overridden = any(path[: len(other)] == other for other in own)
            what = f"{BEHAVIORS}.{self.behavior} has it" if overridden else fate(BEHAVIOR, path)
            yield (DEFAULT_SETTINGS, *path), value, what
        for path, value in own.items():
            yield (BEHAVIORS, self.behavior, *path), value, fate(BEHAVIOR, path)
        for name in self._source.section(BEHAVIORS):
            if name != self.behavior:
                yield (BEHAVIORS, name), {}, f"of another run: --behavior {name}"
        for path, value in leaves(self._source.document.data):
            if path[0] not in (BEHAVIORS, DEFAULT_SETTINGS, SECTION):
                yield path, value, fate(TOP, path)

    def _settle(self, path: KeyPath, value: Any, what: Fate) -> None:
        """Puts a value where it belongs, or drops it."""
        if not isinstance(what, Kept):
            self.account.drop(path, what)
        elif value is None or value == what.absent:
            self.account.drop(path, f"{shown(value)} changes nothing")
        elif not self._is_known(what.target):
            self.account.drop(path, what.otherwise)
        else:
            if what.change is not None and isinstance(value, int | float):
                value = what.change(value)
            self._put(what.target, value, path)
            self.account.keep(path, what.target, what.said)

    def _is_known(self, target: str) -> bool:
        """Whether the trainer has a setting; of other sections all that are asked for are there."""
        section, *steps = target.split(".")
        if section != "trainer" or steps == ["trainer_type"]:
            return True
        owners = models_at(self._settings, tuple(steps[:-1]), {})
        return any(steps[-1] in owner.model_fields for owner in owners)

    def _put(self, target: str, value: Any, path: KeyPath) -> None:
        self._run.set(target, value, self._source.document.where(path))

    def _put_parameters(self, parameters: Parameters) -> None:
        where = self._source.document.where
        if parameters.values:
            self._run.data[SECTION] = parameters.values
            for name in parameters.values:
                self._run.places[SECTION, name] = where((SECTION, name))
        if parameters.curriculum is not None:
            self._run.data["curriculum"] = parameters.curriculum
            first = next(iter(parameters.curriculum["lessons"][0]["parameters"]))
            for index in range(len(parameters.curriculum["lessons"])):
                place = where((SECTION, first, "curriculum", index))
                self._run.places["curriculum", "lessons", index] = place
        for name, given in self._source.section(SECTION).items():
            for path, _ in leaves(given, (SECTION, name)):
                self._account_for(path, parameters)

    def _account_for(self, path: KeyPath, parameters: Parameters) -> None:
        """Says what became of a key of the environment parameters."""
        name, within = str(path[1]), tuple(map(str, path[4:]))
        what = fate(LESSON, within)
        if name in parameters.dropped:
            self.account.drop(path[:2], parameters.dropped[name])
        elif path[-2:] == ("sampler_parameters", "seed"):
            self.account.drop(path, "the run's own seed is drawn from")
        elif name in parameters.values:
            self.account.keep(path[:2], f"{SECTION}.{name}")
        elif within[0] == "value":
            self.account.keep(path[:5], "curriculum.lessons.*.parameters")
        elif within[0] == "completion_criteria" and self._is_last(path):
            self.account.drop(path, "the last lesson does not end")
        elif isinstance(what, Kept):
            self.account.keep(path, what.target, what.said)
        else:
            self.account.drop(path, what)

    def _is_last(self, path: KeyPath) -> bool:
        """Whether a path is of the last lesson of its curriculum."""
        return path[3] == len(self._source.section(SECTION)[str(path[1])]["curriculum"]) - 1

    def _add_defaults(self) -> None:
        for target, value in {**DEFAULTS[""], **DEFAULTS.get(self._trainer, {})}.items():
            if self._is_known(target) and self._get(target) is None:
                self._put(target, value, ())
                self.account.add(target, shown(value))

    def _add_floors(self) -> None:
        """Lets schedules end where ML-Agents' do."""
        for name, floor in FLOORS.items():
            target = f"trainer.hyperparameters.{name}"
            first, schedule = self._get(target), self._get(f"{target}_schedule")
            if schedule == "linear" and isinstance(first, int | float) and first > 0:
                course = {"type": "linear", "final_fraction": min(1.0, floor / first)}
                self._put(f"{target}_schedule", course, (BEHAVIORS, self.behavior))
                self.account.add(f"{target}_schedule.final_fraction", f"it ends at {floor:g}")

    def _get(self, target: str) -> Any:
        value = self._run.data
        for step in target.split("."):
            value = value.get(step) if isinstance(value, dict) else None
        return value
