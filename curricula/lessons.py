"""The curriculum `lessons`: a row of lessons, each ended by a criterion (paper, "Curriculum").

The paper's 19 lessons, in the compact form, where every number goes from a first to a last value::

    curriculum:
      type: lessons
      measure: reward
      count: 19
      thresholds: {first: -0.1, last: 0.8}
      parameters:
        lateral_limit_m: {first: 0.1, last: 0.01, interpolation: exponential}

The same one by one, where parameters may be samplers and lessons may have names::

    curriculum:
      type: lessons
      measure: reward
      lessons:
        - {name: wide, threshold: -0.1, parameters: {lateral_limit_m: 0.1}}
        - {name: narrow, parameters: {lateral_limit_m: 0.01}}
"""

from collections import deque
from collections.abc import Iterator
from fractions import Fraction

from curricula.curriculum import FinishedEpisodes, State
from curricula.lesson_settings import LessonsSettings
from curricula.samplers import ParameterValue


class Lessons:
    """A row of lessons, each over once a measure has passed its threshold.

    The measures `reward` and `success` are smoothed: the mean over the latest episodes of the
    lesson must stay over its threshold for a number of consecutive episodes. Each lesson starts
    with no episodes, and those of a call that are left when a lesson ends count for nothing,
    because they were played under it. With `progress` a lesson ends as soon as the
    fraction of max_steps is over its threshold; one call can then pass several.

    The state holds the lesson's index (`lesson`), the latest values (`window`, up to
    `smoothing_episodes`) and how many episodes in a row were over the threshold (`over`).
    """

    Settings = LessonsSettings

    def __init__(self, settings: LessonsSettings) -> None:
        self._settings = settings
        self._lessons = settings.expand()

    @property
    def lesson_count(self) -> int:
        """Number of lessons."""
        return len(self._lessons)

    def initial_state(self) -> State:
        """State at the start of a run: the first lesson, no episodes."""
        return _begin(0)

    def advance(self, state: State, episodes: FinishedEpisodes) -> State:
        """State after some episodes; ``state`` itself is left as it is.

        Raises:
            ValueError: The state's lesson is not one of these lessons.
        """
        index = self.lesson(state)
        if self._settings.measure == "progress":
            return _begin(self._pass_thresholds(index, episodes.run_fraction))
        threshold = self._lessons[index].threshold
        if threshold is None:
            return _begin(index)  # nothing will ever be asked of the last lesson's episodes
        by_reward = self._settings.measure == "reward"
        measured = episodes.rewards if by_reward else episodes.successes
        return self._smooth(state, threshold, measured.astype(float).tolist())

    def lesson(self, state: State) -> int:
        """Index of the current lesson, from 0.

        Raises:
            ValueError: The state's lesson is not one of these lessons.
        """
        index = state["lesson"]
        if not 0 <= index < self.lesson_count:
            raise ValueError(
                f"the saved state is in the lesson of index {index}, but this curriculum has "
                f"{self.lesson_count} lessons: resume with the curriculum it was saved with"
            )
        return index

    def lesson_name(self, state: State) -> str | None:
        """Name of the current lesson, which the log shows next to its number; None without one."""
        return self._lessons[self.lesson(state)].name

    def parameters(self, state: State) -> dict[str, ParameterValue]:
        """Environment parameters of the current lesson: the same names in each."""
        return dict(self._lessons[self.lesson(state)].parameters)

    def final_parameters(self) -> dict[str, ParameterValue]:
        """Environment parameters of the last lesson."""
        return dict(self._lessons[-1].parameters)

    def all_parameters(self) -> Iterator[dict[str, ParameterValue]]:
        """Environment parameters of each lesson."""
        return (dict(lesson.parameters) for lesson in self._lessons)

    def _pass_thresholds(self, index: int, run_fraction: float) -> int:
        while (
            threshold := self._lessons[index].threshold
        ) is not None and run_fraction > threshold:
            index += 1
        return index

    def _smooth(self, state: State, threshold: float, values: list[float]) -> State:
        # Fractions add without rounding: the sum can be carried from episode to episode, and does
        # not depend on how the episodes were spread over calls, or on a checkpoint between them.
        window = deque(map(Fraction, state["window"]), maxlen=self._settings.smoothing_episodes)
        total = sum(window, Fraction())
        exact_threshold = Fraction(threshold)
        over = state["over"]
        for value in map(Fraction, values):
            if len(window) == window.maxlen:
                total -= window[0]
            window.append(value)
            total += value
            over = over + 1 if total > exact_threshold * len(window) else 0
            if over >= self._settings.min_lesson_length:
                return _begin(state["lesson"] + 1)
        return {"lesson": state["lesson"], "window": [float(v) for v in window], "over": over}


def _begin(index: int) -> State:
    return {"lesson": index, "window": [], "over": 0}
