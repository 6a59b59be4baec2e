"""The sweep file: what is tried, from which run file on, and how."""

from __future__ import annotations

import itertools
import json
import random
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, Field, model_validator

from trainers.common.trainer_settings import TrainerSettings
from trainers.runfile.inheritance import read_run_file
from trainers.runfile.registry import Registries
from trainers.runfile.settings import (
    EvaluationSettings,
    RunSettings,
    load_run,
    load_run_document,
    resolved,
)
from trainers.runfile.validation import InvalidError, float_problems, validate
from trainers.runfile.yaml_document import (
    Document,
    KeyPath,
    Problem,
    SettingsError,
    dotted,
    read,
    shown,
)

Value = bool | int | float | str | None
"""Of a setting that is tried."""
TRIALS = 20
OTHERS_TRIED = 16
"""Draws of the other keys' values, where a value does not go with those of the base."""


class Range(BaseModel, frozen=True, extra="forbid"):
    """Values that a setting may have: one of the three."""

    uniform: tuple[int | float, int | float] | None = Field(
        None, description="The lowest and the highest, drawn evenly between."
    )
    log_uniform: tuple[int | float, int | float] | None = Field(
        None, description="The lowest and the highest, whose logarithms are drawn evenly between."
    )
    choice: tuple[Value, ...] | None = Field(
        None, min_length=1, description="Numbers, text, true, false or null."
    )

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if len(self.model_fields_set) != 1 or (self.choice is None and self._given is None):
            raise ValueError("needs uniform, log_uniform or choice, and one of them alone")
        if self.choice is not None:
            if len(set(map(json.dumps, self.choice))) < len(self.choice):
                raise ValueError("choice: a value is there twice")
            return self
        low, high = self.ends
        if low >= high:
            raise ValueError("should be the lowest, and then the highest, which is over it")
        if self.log and low <= 0:
            raise ValueError("log_uniform: both ends should be over 0")
        return self

    @property
    def _given(self) -> tuple[int | float, int | float] | None:
        return self.uniform or self.log_uniform

    @property
    def ends(self) -> tuple[int | float, int | float]:
        """The lowest and the highest value; not of a choice."""
        assert self._given is not None
        return self._given

    @property
    def log(self) -> bool:
        """Whether logarithms are drawn evenly."""
        return self.log_uniform is not None

    @property
    def outermost(self) -> Sequence[Value]:
        """Values that settings have to take: all choices, or both ends."""
        return self.ends if self.choice is None else self.choice


class SweepSettings(BaseModel, frozen=True, extra="forbid"):
    """What a sweep file says."""

    run: str = Field(min_length=1, description="The base: a run file, as seen from here.")
    fixed: dict[str, Any] = Field(
        default_factory=dict,
        description="What all trials have other than the base, by dotted keys of the run file.",
    )
    space: dict[str, Range] = Field(
        min_length=1, description="What is tried, by dotted keys of the run file."
    )
    sampler: Literal["tpe", "random", "grid"] = Field(
        "tpe",
        description="tpe: draws where trials did well; random; grid: each combination of choices.",
    )
    pruner: Literal["median", "hyperband", "none"] = Field(
        "median", description="What ends a trial early, by its held-out evaluations."
    )
    trials: int | None = Field(
        None, ge=1, description=f"Of the whole sweep; null: {TRIALS}, or all that a grid has."
    )
    seed: int = Field(
        0, ge=0, description="Of what is drawn; a run's own is a setting like others."
    )


@dataclass(frozen=True)
class Sweep:
    """A sweep that was found to be right.

    Attributes:
        path: of the sweep file.
        settings: what it says.
        base: the run file that all trials begin with.
        run: what that says, with what is fixed.
        whole: keys of settings that are whole numbers.
    """

    path: Path
    settings: SweepSettings
    base: Path
    run: RunSettings
    whole: frozenset[str]

    @property
    def name(self) -> str:
        """That of its file."""
        return self.path.stem

    @property
    def evaluation(self) -> EvaluationSettings:
        """How trials are judged."""
        assert self.run.evaluation is not None  # `load_sweep` sees to it
        return self.run.evaluation

    @property
    def max_steps(self) -> int:
        """Steps of a trial, unless that is what is tried."""
        settings = self.run.trainer.settings
        assert isinstance(settings, TrainerSettings)  # the registry sees to it
        return settings.max_steps

    @property
    def cells(self) -> list[dict[str, Value]]:
        """Combinations of a grid."""
        space = self.settings.space
        choices = itertools.product(*(axis.choice or () for axis in space.values()))
        return [dict(zip(space, values, strict=True)) for values in choices]

    def count(self, asked: int | None) -> int:
        """Trials of the whole sweep, of which a grid has no more than its cells.

        Args:
            asked: by the command line, if it says.
        """
        asked = asked or self.settings.trials
        if self.settings.sampler == "grid":
            return min(asked or len(self.cells), len(self.cells))
        return asked or TRIALS

    def overrides(self, values: Mapping[str, Value]) -> list[str]:
        """What the command line lays over the base to have a trial: `KEY=VALUE`."""
        settings = {**self.settings.fixed, **values}
        return [f"{key}={json.dumps(value)}" for key, value in settings.items()]

    def run_of(self, values: Mapping[str, Value], registries: Registries) -> RunSettings:
        """A trial's run.

        Raises:
            SettingsError: the settings refuse these values together.
        """
        return load_run(self.base, self.overrides(values), registries)

    @property
    def definition(self) -> dict[str, Any]:
        """What makes it another sweep if it differs, as plain data."""
        settings = self.settings.model_dump(mode="json", include={"space", "sampler"})
        return {"run": resolved(self.run), **settings}


def load_sweep(path: Path, registries: Registries) -> Sweep:
    """Reads a sweep file, and tries its keys and values on the settings.

    Raises:
        SettingsError: with everything that is wrong, where it stands, and what is allowed.
    """
    document = read(path)
    settings = _settings(document)
    base = path.parent / settings.run
    if not base.is_file():
        message = f"there is no file {base}; write it as seen from {path.parent}"
        raise SettingsError([Problem(document.where(("run",)), ("run",), message)])
    common = read_run_file(base)
    for key, value in settings.fixed.items():
        common.set(key, value, document.where(("fixed", key)))
    run = load_run_document(common, [], registries)
    if run.evaluation is None:
        message = "missing: trials are judged by it; write it there, or here under `fixed`"
        raise SettingsError([Problem(str(base), ("evaluation",), message)])
    trying = _Trying(settings.space, common, document, registries)
    whole = frozenset(key for key in settings.space if trying.is_whole(key))
    sweep = Sweep(path, settings, base, run, whole)
    if settings.sampler == "grid" and not trying.problems:
        for values in sweep.cells[: sweep.count(None)]:
            trying.try_cell(values)
    if trying.problems:
        raise SettingsError(trying.problems)
    return sweep


def _settings(document: Document) -> SweepSettings:
    problems: list[tuple[KeyPath, str]]
    problems = list(float_problems(document.data))
    if not problems:
        try:
            settings = validate(SweepSettings, document.data)
        except InvalidError as error:
            problems = error.problems
        else:
            problems = _not_in_a_grid(settings)
            if not problems:
                return settings
    raise SettingsError([Problem(document.where(path), path, said) for path, said in problems])


def _not_in_a_grid(settings: SweepSettings) -> list[tuple[KeyPath, str]]:
    if settings.sampler != "grid":
        return []
    ranges = [key for key, axis in settings.space.items() if axis.choice is None]
    return [(("space", key), "should be a choice: a grid has no other") for key in ranges]


class _Trying:
    """Tries values on the settings, each with some of the others.

    Attributes:
        problems: what is wrong, at the sweep file's lines.
    """

    def __init__(
        self,
        space: Mapping[str, Range],
        common: Document,
        sweep_file: Document,
        registries: Registries,
    ):
        self._space, self._common, self._sweep_file = space, common, sweep_file
        self._registries, self._random = registries, random.Random(0)
        self.problems: list[Problem] = []

    def is_whole(self, key: str) -> bool:
        """Whether a range is of whole numbers, as the settings read its ends.

        What they refuse is a problem, unless they take it with other values of other keys.
        """
        axis = self._space[key]
        found = [self._accepted(key, value) for value in axis.outermost]
        return axis.choice is None and all(isinstance(value, int) for value in found)

    def try_cell(self, values: Mapping[str, Value]) -> None:
        """Tries all values of a grid's cell together."""
        try:
            self._run(values)
        except SettingsError as error:
            said = ", ".join(f"{key} {shown(value)}" for key, value in values.items())
            for problem in error.problems:
                self._refuse(("space",), f"{said}: {dotted(problem.path)}: ", problem.message)

    def _accepted(self, key: str, value: Value) -> Any:
        """A value as the settings read it; None where they refuse it."""
        try:
            return self._read(key, {key: value})
        except SettingsError as error:
            for _ in range(OTHERS_TRIED):
                others = {k: self._random.choice(axis.outermost) for k, axis in self._space.items()}
                with suppress(SettingsError):
                    return self._read(key, {**others, key: value})
            for problem in error.problems:
                name = dotted(problem.path)
                about = "" if name == key else f"with {shown(value)}, {name}: "
                self._refuse(("space", key), about, problem.message)
        return None

    def _read(self, key: str, values: Mapping[str, Value]) -> Any:
        """What the settings make of a key's value, None where it is no key any more.

        Raises:
            SettingsError: they refuse the values.
        """
        found: Any = resolved(self._run(values))
        try:
            for step in key.split("."):
                found = found[int(step) if isinstance(found, list) else step]
        except KeyError:
            self._refuse(("space", key), "", "has another name now, or is no setting any more")
            return None
        return found

    def _run(self, values: Mapping[str, Value]) -> RunSettings:
        trial = deepcopy(self._common)
        for key, value in values.items():
            trial.set(key, value, "")
        return load_run_document(trial, [], self._registries)

    def _refuse(self, at: KeyPath, about: str, said: str) -> None:
        problem = Problem(self._sweep_file.where(at), at, about + said)
        if problem not in self.problems:  # as both ends of an unknown key are
            self.problems.append(problem)
