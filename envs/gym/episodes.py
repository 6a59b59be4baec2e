"""Episodes of any environment that can be played again, so that a run can go on exactly.

The state of a gymnasium environment is its own affair and can't be saved. But an environment whose
only randomness is gymnasium's `np_random` does the same again from the same seed with the same
actions. So every episode begins with a seed of its own, and a running one is restored by playing
it again.
"""

from __future__ import annotations

import copy
import traceback
from collections import deque
from collections.abc import Collection, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from curricula.samplers import ParameterValue
from envs.environment import EnvironmentFailure
from envs.gym.parameters import AttributeParameters, pick
from envs.gym.returned import WrongReturn, checked_frame, checked_reset, checked_step

IS_SUCCESS = "is_success"
"""Key of an info that says whether the episode is a success, as Stable-Baselines3 reads it."""


def episode_seed(run_seed: int, index: int, episode: int) -> int:
    """The seed, from 0 to 2^31 - 1, of an episode (from 0) of one of a run's environments."""
    # As a spawn key, because entropy of different lengths may be the same: (1, 0) is (1,).
    word = np.random.SeedSequence(run_seed, spawn_key=(index, episode)).generate_state(1)[0]
    return int(word >> 1)  # some environments pass it to generators that take 31 bits


class RepeatableEpisodes(gymnasium.Wrapper[Any, Any, Any, Any]):
    """One of a run's environments; seeds each of its episodes, and checks what it returns.

    The environment's parameters are drawn for each episode, from a stream that follows from its
    number as its seed does.

    An environment may use an array again that it has handed out, or share it with the others in its
    process. So observations are copied before anything else happens, and so is the info that an
    episode ended with.

    Args:
        env: the environment.
        name: for messages.
        run_seed: of the run.
        index: which of the environments beside it it is, from 0.
        with_infos: pass on the infos of steps. Otherwise they are empty, but for an episode's
            success at its end: to gather those of many environments takes longer than many a step.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        name: str,
        run_seed: int,
        index: int,
        *,
        with_infos: bool = False,
    ):
        super().__init__(env)
        self._name, self._space = name, env.observation_space
        self._run_seed, self._index, self._with_infos = run_seed, index, with_infos
        self._number = index
        self._begun = self._steps = 0  # episodes, and steps of the last of them
        self._last_info: dict[str, Any] = {}
        self._parameters = AttributeParameters(env)
        self._drawn: dict[str, float] = {}
        self._is_filmed = False
        self._pictures: list[NDArray[np.uint8]] = []

    def known_parameters(self) -> frozenset[str]:
        """Names of the environment's parameters."""
        return self._parameters.names

    def set_parameters(self, parameters: Mapping[str, ParameterValue]) -> None:
        """Sets parameters of the episodes that begin from now on."""
        self._parameters.given = parameters

    def drawn_parameters(self) -> dict[str, float]:
        """What was drawn for the running episode."""
        return self._drawn

    def number_from(self, first: int) -> None:
        """Says that it is one of those with the numbers `first` on; before that they begin with 0.

        It is as its number, of all the run's environments, that its episodes are seeded.
        """
        self._number = first + self._index

    def count_from(self, run_seed: int, begun: NDArray[np.int64]) -> None:
        """Goes to where some episodes had begun.

        Args:
            run_seed: of the run.
            begun: (N,) how many, of all environments beside it.
        """
        self._run_seed, self._begun = run_seed, int(begun[self._index])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins the next episode, with its own seed whatever `seed` is.

        The info is that of the step which ended the episode before, for gymnasium resets within a
        step, and gathers then what a reset says.

        Raises:
            EnvironmentFailure: the environment failed, or returned what it may not.
        """
        return self._begin({}, options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment; errors as `reset`'s."""
        self._steps += 1
        try:
            returned = self.env.step(action)
            observation, reward, terminated, truncated, info = checked_step(self._space, returned)
            if self._is_filmed:
                self._pictures.append(checked_frame(self.env.render()))
        except (Exception, SystemExit) as error:
            raise self._failure(error) from error
        ended = terminated or truncated
        if not self._with_infos:
            info = {IS_SUCCESS: info[IS_SUCCESS]} if ended and IS_SUCCESS in info else {}
        if ended:
            info = self._last_info = copy.deepcopy(info)
        return _copied(observation), reward, terminated, truncated, info

    def play(
        self,
        drawn: Mapping[str, NDArray[np.float64]],
        lengths: NDArray[np.int64],
        actions: NDArray[Any],
    ) -> Any:
        """Plays an episode from its beginning; returns the last observation.

        Args:
            drawn: (N,) values of its parameters by name, of all environments beside it; where there
                is NaN, one is drawn.
            lengths: (N,) steps of the episode, of all environments beside it.
            actions: (T, N, ...) the last T steps' actions, T being the greatest length.
        """
        observation, _ = self._begin(pick(drawn, self._index), None)
        for action in actions[len(actions) - lengths[self._index] :, self._index].copy():
            observation, *_ = self.step(action)
        return observation

    def film(self, rows: Collection[int]) -> None:
        """See `Environment.film`; rows are those of all the run's environments.

        Raises:
            EnvironmentFailure: the environment can't be rendered.
        """
        self._is_filmed = self._index in rows
        try:
            self._pictures = [checked_frame(self.env.render())] if self._is_filmed else []
        except (Exception, SystemExit) as error:
            raise self._failure(error) from error

    def pop_frames(self) -> list[NDArray[np.uint8]]:
        """Frames (H, W, 3) since the last call."""
        pictures, self._pictures = self._pictures, []
        return pictures

    def _begin(
        self, drawn: Mapping[str, float], options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins the next episode, with some parameters' values; the others are drawn."""
        number = (self._run_seed, self._number, self._begun)
        self._begun += 1
        self._steps = 0
        self._drawn = {**self._parameters.draw(*number), **drawn}
        try:
            self._parameters.apply(self._drawn)
            returned = self.env.reset(seed=episode_seed(*number), options=options)
            observation, _ = checked_reset(self._space, returned)
        except (Exception, SystemExit) as error:
            raise self._failure(error) from error
        info, self._last_info = self._last_info, {}
        return _copied(observation), info

    def _failure(self, error: BaseException) -> EnvironmentFailure:
        """Says which environment failed, when, why and where."""
        call = f"step {self._steps}" if self._steps else "the reset"
        reason = str(error)
        if not isinstance(error, WrongReturn):
            place = traceback.extract_tb(error.__traceback__)[-1]
            said = f"{type(error).__name__}: {error}".removesuffix(": ")
            reason = f"{said} ({place.filename}:{place.lineno})"
        return EnvironmentFailure(
            f"environment {self._number} of {self._name!r} failed in {call} of its episode "
            f"{self._begun}: {reason}"
        )


class StackedEpisodes(RepeatableEpisodes):
    """The same, with the latest observations in the place of the last.

    What is observed is a tuple, the oldest first; an episode's first observation stands for those
    that would be before it.

    Args:
        frame_stack: how many observations; the others are those of `RepeatableEpisodes`.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        name: str,
        run_seed: int,
        index: int,
        frame_stack: int,
        *,
        with_infos: bool = False,
    ):
        super().__init__(env, name, run_seed, index, with_infos=with_infos)
        self._frames: deque[Any] = deque(maxlen=frame_stack)
        self._frame_stack = frame_stack
        self.observation_space = gymnasium.spaces.Tuple([self._space] * frame_stack)

    def _begin(
        self, drawn: Mapping[str, float], options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = super()._begin(drawn, options)
        self._frames.extend([observation] * self._frame_stack)
        return tuple(self._frames), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See `RepeatableEpisodes`."""
        observation, *rest = super().step(action)
        self._frames.append(observation)
        return tuple(self._frames), *rest


def _copied(observation: Any) -> Any:
    """A copy of whatever a space holds; of an array in a fifth of the time of a deep copy."""
    if isinstance(observation, np.ndarray):
        return observation.copy()
    return copy.deepcopy(observation)
