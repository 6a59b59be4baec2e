"""The run file: YAML to frozen, validated settings, and back.

Every section names a component by its `type` (the trainer by its `trainer_type`); the registry
finds its class, and the class's own `Settings` model validates the section's other keys.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, Field, TypeAdapter

from curricula.samplers import ParameterValue
from trainers.common.errors import suggestion
from trainers.runfile.foreign_keys import foreign_file
from trainers.runfile.former_keys import brought_up_to_date, tell
from trainers.runfile.inheritance import read_run_file
from trainers.runfile.overrides import override
from trainers.runfile.registry import Registries, Registry, UnknownComponentError
from trainers.runfile.validation import InvalidError, Model, float_problems, validate
from trainers.runfile.yaml_document import (
    Document,
    KeyPath,
    Problem,
    SettingsError,
    dump,
    read,
    shown,
)

__all__ = [
    "Component",
    "RunSettings",
    "SettingsError",
    "WeightedReward",
    "dump_yaml",
    "load_run",
    "resolved",
]

TYPE_KEY = "type"
TRAINER_TYPE_KEY = "trainer_type"
DEFAULT_LOGGERS = [{TYPE_KEY: "tensorboard"}]
PARAMETERS = TypeAdapter(dict[str, ParameterValue])


@dataclass(frozen=True)
class Component:
    """A component that a run uses: its class, and its settings, not yet built."""

    name: str
    """The name it is registered under."""
    cls: type[Any]
    settings: BaseModel
    """An instance of `cls.Settings`."""


@dataclass(frozen=True)
class WeightedReward:
    """A reward, and the factor it enters the sum with."""

    component: Component
    weight: float


@dataclass(frozen=True)
class RunSettings:
    """Everything that defines a run."""

    environment: Component
    rewards: tuple[WeightedReward, ...]
    encoders: dict[str, Component]
    """By the name of the observation."""
    curriculum: Component | None
    environment_parameters: dict[str, ParameterValue]
    """Values that hold for the whole run, unless the curriculum sets them."""
    trainer: Component
    evaluation: EvaluationSettings | None
    loggers: tuple[Component, ...]
    seed: int
    device: str

    def with_environments(self, most: int) -> RunSettings:
        """The same with so many environments at most, where their number is a setting."""
        settings = self.environment.settings
        if getattr(settings, "num_envs", 1) <= most:
            return self
        few = settings.model_copy(update={"num_envs": most})
        return replace(self, environment=replace(self.environment, settings=few))


@dataclass(frozen=True)
class PolicyComponents:
    """Components of a policy's networks."""

    encoders: dict[str, Component]
    """By the name of the observation."""
    trainer: Component


class Target(BaseModel, frozen=True, extra="forbid"):
    """Goal at which a run may stop."""

    metric: str = Field(
        min_length=1, description="A figure of the evaluation, such as success or reward."
    )
    at_least: float = Field(description="The run ends once the figure is this or more.")


class EvaluationSettings(BaseModel, frozen=True, extra="forbid"):
    """Evaluation while the run learns, on the last lesson's task, in environments of its own."""

    # What a run may go on with other values of; its scores stay comparable.
    changeable_keys: ClassVar[frozenset[str]] = frozenset({"interval", "stop_when"})

    interval: int = Field(ge=1, description="Steps of training between two evaluations.")
    episodes: int = Field(100, ge=1, le=10**6, description="Episodes of each evaluation.")
    seed: int = Field(
        1,
        ge=0,
        lt=2**31,
        description="Seed of the episodes, which no run trains on; `trainers.evaluate` has 0, so "
        "that a checkpoint is not judged by the very episodes that it was chosen by.",
    )
    stop_when: Target | None = Field(None, description="Ends the run before max_steps.")


class RunFile(BaseModel, frozen=True, extra="forbid"):
    """The top of the run file; a section left empty is as good as absent."""

    environment: dict[str, Any] = Field(description="The environment: its type and settings.")
    rewards: list[dict[str, Any]] | None = Field(
        None, description="The rewards: type, weight (default 1) and settings of each."
    )
    encoders: dict[str, dict[str, Any]] | None = Field(
        None, description="For each observation the encoder's type and settings."
    )
    curriculum: dict[str, Any] | None = Field(
        None, description="The curriculum: its type and settings."
    )
    environment_parameters: dict[str, ParameterValue] | None = Field(
        None, description="Values or samplers of parameters that the environment lists."
    )
    trainer: dict[str, Any] = Field(description="The algorithm: its trainer_type and settings.")
    evaluation: EvaluationSettings | None = Field(
        None, description="Evaluation while the run learns; the best checkpoint is chosen by it."
    )
    loggers: list[dict[str, Any]] | None = Field(
        None, description="The loggers: type and settings of each; TensorBoard alone if absent."
    )
    seed: int = Field(0, ge=0, lt=2**32, description="Seed of everything that is random.")
    device: str = Field("cpu", min_length=1, description="Device of the networks, as torch has it.")


class Weight(BaseModel, frozen=True, extra="forbid"):
    """What stands beside a reward's own settings."""

    weight: float = Field(1.0, description="Factor of the reward in the sum.")


def load_run(path: Path, overrides: Sequence[str], registries: Registries) -> RunSettings:
    """Read, override and validate a run file.

    Args:
        path: the YAML file.
        overrides: `KEY=VALUE` each, KEY a dotted path into the file and VALUE YAML.
        registries: the components that can be named.

    Raises:
        SettingsError: with everything that is wrong, where it stands, and what is allowed.
    """
    return load_run_document(read_run_file(path), overrides, registries)


def load_run_document(
    document: Document, overrides: Sequence[str], registries: Registries
) -> RunSettings:
    """Override and validate what a run file says; see `load_run`."""
    override(document, overrides, registries)
    return _Sections(document, registries).run()


def load_policy(path: Path, registries: Registries) -> PolicyComponents:
    """Read what a run file says of the policy's networks; its other sections are not looked at.

    Raises:
        SettingsError: with everything that is wrong, where it stands, and what is allowed.
    """
    return _Sections(read(path), registries).policy()


def resolved(run: RunSettings) -> dict[str, Any]:
    """A run as plain data with every default written out.

    Dumped as YAML and loaded again, it gives an equal run.
    """
    data: dict[str, Any] = {"environment": _plain(run.environment)}
    data["rewards"] = [
        {TYPE_KEY: reward.component.name, "weight": reward.weight, **_own(reward.component)}
        for reward in run.rewards
    ]
    data["encoders"] = {name: _plain(encoder) for name, encoder in run.encoders.items()}
    data["curriculum"] = run.curriculum and _plain(run.curriculum)
    data["environment_parameters"] = PARAMETERS.dump_python(run.environment_parameters, mode="json")
    data["trainer"] = _plain(run.trainer, TRAINER_TYPE_KEY)
    data["evaluation"] = run.evaluation and run.evaluation.model_dump(mode="json")
    data["loggers"] = [_plain(logger) for logger in run.loggers]
    return {**data, "seed": run.seed, "device": run.device}


def dump_yaml(run: RunSettings) -> str:
    """Write `resolved(run)` as YAML."""
    return dump(resolved(run))


def _plain(component: Component, type_key: str = TYPE_KEY) -> dict[str, Any]:
    return {type_key: component.name, **_own(component)}


def _own(component: Component) -> dict[str, Any]:
    return component.settings.model_dump(mode="json", by_alias=True, round_trip=True)


class _Sections:
    """Validates the sections of a document, gathering the problems of all of them."""

    def __init__(self, document: Document, registries: Registries) -> None:
        self.document = document
        self.registries = registries
        self.problems: list[Problem] = []

    def run(self) -> RunSettings:
        if problem := foreign_file(self.document):
            raise SettingsError([problem])
        for path, said in float_problems(self.document.data):
            self.problem(path, said)
        if self.problems:
            raise SettingsError(self.problems)
        top = self.validate(RunFile, self.document.data, ())
        # The sections are looked at even where the top is wrong, to tell everything at once.
        found = self.registries
        environment = self.component("environment", found.environments)
        rewards, encoders, loggers = self.rewards(), self.encoders(), self.loggers()
        curriculum = self.component("curriculum", found.curricula)
        trainer = self.component("trainer", found.trainers, TRAINER_TYPE_KEY)
        if self.problems or top is None or environment is None or trainer is None:
            raise SettingsError(self.problems)
        return RunSettings(
            environment=environment,
            rewards=tuple(rewards),
            encoders=encoders,
            curriculum=curriculum,
            environment_parameters=top.environment_parameters or {},
            trainer=trainer,
            evaluation=top.evaluation,
            loggers=tuple(loggers),
            seed=top.seed,
            device=top.device,
        )

    def policy(self) -> PolicyComponents:
        encoders = self.encoders()
        trainer = self.component("trainer", self.registries.trainers, TRAINER_TYPE_KEY)
        if self.problems or trainer is None:
            raise SettingsError(self.problems)
        return PolicyComponents(encoders, trainer)

    def encoders(self) -> dict[str, Component]:
        found = {
            name: self.section(("encoders", name), section, self.registries.encoders)
            for name, section in self.mapping("encoders").items()
            if isinstance(section, dict)
        }
        return {name: encoder for name, encoder in found.items() if encoder}

    def mapping(self, key: str) -> dict[str, Any]:
        """A section; empty where it is absent or, as was noted at the top, no mapping."""
        section = self.document.data.get(key)
        return section if isinstance(section, dict) else {}

    def component(self, key: str, registry: Registry, type_key: str = TYPE_KEY) -> Component | None:
        section = self.document.data.get(key)
        if not isinstance(section, dict):
            return None
        return self.section((key,), section, registry, type_key)

    def rewards(self) -> list[WeightedReward]:
        rewards: list[WeightedReward] = []
        for path, section in self.entries("rewards"):
            own = {key: value for key, value in section.items() if key != "weight"}
            weighed = {key: value for key, value in section.items() if key == "weight"}
            component = self.section(path, own, self.registries.rewards, beside=("weight",))
            weight = self.validate(Weight, weighed, path)
            if component is not None and weight is not None:
                rewards.append(WeightedReward(component, weight.weight))
        return rewards

    def loggers(self) -> list[Component]:
        found = [
            self.section(path, section, self.registries.loggers)
            for path, section in self.entries("loggers", DEFAULT_LOGGERS)
        ]
        return [logger for logger in found if logger]

    def entries(
        self, key: str, default: Sequence[dict[str, Any]] = ()
    ) -> Iterator[tuple[KeyPath, dict[str, Any]]]:
        """The sections of a list, each of another type; what is none was noted at the top."""
        given = self.document.data.get(key)
        sections = given if isinstance(given, list) else default if given is None else ()
        first: dict[str, int] = {}
        for index, section in enumerate(sections):
            if not isinstance(section, dict):
                continue
            name = section.get(TYPE_KEY)
            yield (key, index), section
            if isinstance(name, str) and (earlier := first.setdefault(name, index)) != index:
                message = f"'{name}' is there already, as {key}.{earlier}; keep one"
                self.problem((key, index, TYPE_KEY), message)

    def section(
        self,
        path: KeyPath,
        section: Mapping[str, Any],
        registry: Registry,
        type_key: str = TYPE_KEY,
        beside: tuple[str, ...] = (),
    ) -> Component | None:
        """Find a section's component and validate its settings; None where there is a problem."""
        name = section.get(type_key)
        if not isinstance(name, str):
            wrong = f"should be text, not {shown(name)}" if type_key in section else "missing"
            names = suggestion("", registry.entries)
            self.problem((*path, type_key), f"{wrong}: names the {registry.kind}; {names}")
            return None
        try:
            entry = registry.get(name)
        except UnknownComponentError as error:
            message = f"{error} (`python -m trainers.plugins` lists all)"
            self.problem((*path, type_key), message)
            return None
        own = {key: value for key, value in section.items() if key != type_key}
        own, changes = brought_up_to_date(own, path, entry.settings)
        for former, said in changes.items():
            tell(str(Problem(self.document.where(former), former, said)))
        settings = self.validate(entry.settings, own, path, (type_key, *beside))
        return None if settings is None else Component(name, entry.cls, settings)

    def validate(
        self, model: type[Model], data: Any, path: KeyPath, beside: tuple[str, ...] = ()
    ) -> Model | None:
        try:
            return validate(model, data, beside)
        except InvalidError as error:
            for inner, message in error.problems:
                self.problem((*path, *inner), message)
            return None

    def problem(self, path: KeyPath, message: str) -> None:
        self.problems.append(Problem(self.document.where(path), path, message))
