"""Environment parameters of ML-Agents: numbers, samplers, and a curriculum for each parameter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, Field

from trainers.convert.source import Source
from trainers.runfile.validation import InvalidError, validate
from trainers.runfile.yaml_document import KeyPath, SettingsError

SECTION = "environment_parameters"
SAMPLER_DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "constant": {"value": 0.0},
    "uniform": {"min_value": 0.0, "max_value": 1.0},
    "gaussian": {"mean": 1.0, "st_dev": 1.0},
    "multirangeuniform": {"intervals": [[0.0, 1.0]]},
}


class Criteria(BaseModel, frozen=True, extra="forbid"):
    """When a lesson of ML-Agents' ends."""

    behavior: str = Field(description="The behavior whose training ends it.")
    measure: Literal["progress", "reward"] = Field("reward", description="Of that training.")
    threshold: float = Field(0.0, description="What the measure has to be over.")
    min_lesson_length: int = Field(0, description="Episodes that the lesson has at least.")
    signal_smoothing: bool = Field(True, description="Whether the mean is smoothed again.")
    require_reset: bool = Field(False, description="Whether environments are reset first.")


class Lesson(BaseModel, frozen=True, extra="forbid"):
    """A lesson of one parameter's curriculum."""

    name: str = Field(description="Of the lesson.")
    value: Any = Field(description="A number or a sampler of the parameter.")
    completion_criteria: Criteria | None = Field(None, description="When it ends.")


class OwnCurriculum(BaseModel, frozen=True, extra="forbid"):
    """A parameter that has lessons."""

    curriculum: tuple[Lesson, ...] = Field(min_length=1, description="Its lessons, in order.")

    def ends(self) -> list[Criteria]:
        """Criteria of all lessons but the last, which does not end."""
        criteria = [lesson.completion_criteria for lesson in self.curriculum[:-1]]
        return [each for each in criteria if each is not None]


class Parameters(NamedTuple):
    """What becomes of the environment parameters."""

    values: dict[str, Any]
    """Section `environment_parameters`."""
    curriculum: dict[str, Any] | None
    """Section `curriculum`."""
    dropped: dict[str, str]
    """Parameter -> why it is left out."""


def convert_parameters(source: Source, behavior: str) -> Parameters:
    """Environment parameters as a run file has them.

    ML-Agents has a curriculum for each parameter, and a run file has one for all: those of further
    parameters join in if their lessons end with the first one's.

    Args:
        source: the file.
        behavior: whose training it is.

    Raises:
        SettingsError: a curriculum is none of ML-Agents'.
    """
    values: dict[str, Any] = {}
    dropped: dict[str, str] = {}
    together: dict[str, OwnCurriculum] = {}
    for name, given in source.section(SECTION).items():
        if not (isinstance(given, dict) and "curriculum" in given):
            values[name] = parameter_value(given)
            continue
        own = _read(source, (SECTION, name), given)
        if not own.ends():
            values[name] = parameter_value(own.curriculum[0].value)
        elif why := _misfit(own, behavior, together):
            dropped[name] = why
        else:
            together[name] = own
    return Parameters(values, _lessons(together) if together else None, dropped)


def parameter_value(given: Any) -> Any:
    """A number or a sampler, with ML-Agents' defaults; what is neither, as it is."""
    if not isinstance(given, dict):
        return given
    kind, parameters = str(given.get("sampler_type")), given.get("sampler_parameters")
    if kind not in SAMPLER_DEFAULTS or not isinstance(parameters, dict):
        return given
    own = {key: value for key, value in parameters.items() if key != "seed"}
    full = {**SAMPLER_DEFAULTS[kind], **own}
    if kind == "constant":
        return full["value"]
    return {"sampler_type": kind, "sampler_parameters": full}


def _read(source: Source, path: KeyPath, given: Any) -> OwnCurriculum:
    try:
        own = validate(OwnCurriculum, given)
    except InvalidError as error:
        raise SettingsError(
            [source.problem((*path, *inner), message) for inner, message in error.problems]
        ) from error
    for index, lesson in enumerate(own.curriculum[:-1]):
        if lesson.completion_criteria is None:
            message = "needs completion_criteria: all lessons but the last end"
            raise SettingsError([source.problem((*path, "curriculum", index), message)])
    if len({end.measure for end in own.ends()}) > 1:
        message = "ends some lessons by progress and some by reward, and a run by one of them"
        raise SettingsError([source.problem((*path, "curriculum"), message)])
    return own


def _misfit(own: OwnCurriculum, behavior: str, together: Mapping[str, OwnCurriculum]) -> str | None:
    """Why a curriculum can't join others in one of a behavior's run; None if it can."""
    for end in own.ends():
        if end.behavior != behavior:
            return (
                f"its lessons end by the behavior {end.behavior!r}, which is a run of its own: set "
                "it in environment_parameters if the environment needs it"
            )
    for name, first in together.items():
        if own.ends() != first.ends():
            return (
                f"its lessons end otherwise than those of {name!r}, and a run has one curriculum: "
                "write both into its lessons"
            )
    return None


def _lessons(together: Mapping[str, OwnCurriculum]) -> dict[str, Any]:
    """One curriculum of parameters whose lessons end together."""
    first = next(iter(together.values()))
    lessons: list[dict[str, Any]] = []
    for index, lesson in enumerate(first.curriculum):
        values = {name: own.curriculum[index].value for name, own in together.items()}
        ends = {} if index == len(first.ends()) else {"threshold": first.ends()[index].threshold}
        parameters = {name: parameter_value(value) for name, value in values.items()}
        lessons.append({"name": lesson.name, **ends, "parameters": parameters})
    episodes = max(1, *(end.min_lesson_length for end in first.ends()))
    return {
        "type": "lessons",
        "measure": first.ends()[0].measure,
        "smoothing_episodes": episodes,
        "min_lesson_length": episodes,
        "lessons": lessons,
    }
