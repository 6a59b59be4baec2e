"""Settings of the curriculum `lessons`, and their expansion into every lesson in full."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, Self

from pydantic import BaseModel, Field, FiniteFloat, model_validator

from curricula.interpolation import Interpolation
from curricula.samplers import ParameterValue


class LessonSettings(BaseModel, frozen=True, extra="forbid"):
    """One lesson of a curriculum that is written lesson by lesson."""

    name: str | None = Field(
        default=None, min_length=1, description="Name of the lesson in the log, next to its number."
    )
    threshold: FiniteFloat | None = Field(
        default=None,
        description="What the measure must pass to end the lesson; the last lesson has none.",
    )
    parameters: dict[str, ParameterValue] = Field(
        default={},
        description="Environment parameters which the lesson changes, as numbers or samplers; "
        "those it leaves out stay as in the lesson before.",
    )


@dataclass(frozen=True)
class Lesson:
    """A lesson worked out in full.

    Attributes:
        name: What the log calls it next to its number; None if it has none.
        threshold: What the measure must pass to end it; None for the last lesson.
        parameters: Every environment parameter that the curriculum sets.
    """

    name: str | None
    threshold: float | None
    parameters: dict[str, ParameterValue]


class LessonsSettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of the curriculum `lessons`: compact or lesson by lesson, not both."""

    measure: Literal["reward", "success", "progress"] = Field(
        default="reward",
        description="What is held against the thresholds: the smoothed cumulative reward of the "
        "episodes, their smoothed success rate, or the fraction of max_steps that is done.",
    )
    smoothing_episodes: int = Field(
        default=100,
        ge=1,
        description="The smoothed value is the mean over up to this many latest finished episodes "
        "of the lesson; without effect on progress.",
    )
    min_lesson_length: int = Field(
        default=100,
        ge=1,
        description="The smoothed value must stay over the threshold for this many consecutive "
        "episodes; without effect on progress.",
    )
    count: int | None = Field(
        default=None, ge=1, le=10_000, description="Compact form: the number of lessons."
    )
    thresholds: Interpolation | None = Field(
        default=None, description="Compact form: the thresholds of all lessons but the last."
    )
    parameters: dict[str, Interpolation] | None = Field(
        default=None,
        min_length=1,
        description="Compact form: the environment parameters, from the first lesson to the last.",
    )
    lessons: tuple[LessonSettings, ...] | None = Field(
        default=None,
        min_length=1,
        description="The lessons one by one, instead of the compact form.",
    )

    @model_validator(mode="after")
    def _valid(self) -> Self:
        if self.lessons is None:
            self._check_compact_form()
        else:
            self._check_listed_form(self.lessons)
        thresholds = [lesson.threshold for lesson in self.expand() if lesson.threshold is not None]
        if self.measure == "progress":
            _check_progress_thresholds(thresholds)
        elif self.measure == "success":
            _check_success_thresholds(thresholds)
        return self

    def _check_compact_form(self) -> None:
        if self.count is None:
            raise ValueError(
                "there are no lessons: give 'count', 'thresholds' and 'parameters', or 'lessons'"
            )
        if self.parameters is None:
            raise ValueError(
                f"{self.count} lessons without 'parameters' are all the same: give the "
                "environment parameters that they change"
            )
        if self.count > 1 and self.thresholds is None:
            raise ValueError(
                f"{self.count} lessons need thresholds: add 'thresholds: {{first: ..., last: ...}}'"
            )

    def _check_listed_form(self, lessons: tuple[LessonSettings, ...]) -> None:
        given = [
            key for key in ("count", "thresholds", "parameters") if getattr(self, key) is not None
        ]
        if given:
            raise ValueError(
                f"'lessons' and {', '.join(map(repr, given))} are both given: write the lessons "
                "one by one or in the compact form, not both"
            )
        first, last = lessons[0], lessons[-1]
        for number, lesson in enumerate(lessons, start=1):
            if lesson.threshold is None and lesson is not last:
                raise ValueError(
                    f"lesson {number} of {len(lessons)} has no threshold: every lesson but the "
                    "last needs one"
                )
            if unknown := sorted(lesson.parameters.keys() - first.parameters.keys()):
                raise ValueError(
                    f"lesson {number} sets {', '.join(map(repr, unknown))}, which the first "
                    "lesson does not: give the first lesson a value too"
                )
        if last.threshold is not None:
            raise ValueError(
                f"the last lesson has the threshold {last.threshold:g}, but never ends: leave it "
                "out or add a lesson after it"
            )
        if not first.parameters:
            raise ValueError("the lessons are all the same: give them 'parameters'")

    def expand(self) -> tuple[Lesson, ...]:
        """All lessons, each with all of its parameters."""
        if self.lessons is None:
            return self._expand_compact_form()
        expanded: list[Lesson] = []
        parameters: dict[str, ParameterValue] = {}
        for lesson in self.lessons:
            parameters = parameters | lesson.parameters
            expanded.append(Lesson(lesson.name, lesson.threshold, parameters))
        return tuple(expanded)

    def _expand_compact_form(self) -> tuple[Lesson, ...]:
        count = self.count or 0
        thresholds: tuple[float | None, ...] = (None,)
        if self.thresholds is not None:
            thresholds = (*self.thresholds.values(count - 1), None)
        rows = {name: ends.values(count) for name, ends in (self.parameters or {}).items()}
        return tuple(
            Lesson(None, thresholds[index], {name: row[index] for name, row in rows.items()})
            for index in range(count)
        )


def _check_progress_thresholds(thresholds: list[float]) -> None:
    for threshold in thresholds:
        if not 0 <= threshold < 1:
            raise ValueError(
                f"the progress threshold {threshold:g} is never passed or passed at once: it is a "
                "fraction of max_steps, from 0 to less than 1"
            )
    for earlier, later in pairwise(thresholds):
        if later <= earlier:
            raise ValueError(
                f"the progress thresholds must rise, but {later:g} follows {earlier:g}"
            )


def _check_success_thresholds(thresholds: list[float]) -> None:
    for threshold in thresholds:
        if not 0 <= threshold < 1:
            raise ValueError(
                f"the success threshold {threshold:g} is never passed or passed at once: it is a "
                "fraction of the episodes, from 0 to less than 1"
            )
