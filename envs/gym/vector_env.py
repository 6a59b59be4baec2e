"""Any environment registered with gymnasium: N of them, stepped together."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from numpy.typing import NDArray
from pydantic import BaseModel

from curricula.samplers import ParameterValue
from envs.environment import Environment, EnvironmentFailure, ObservationArrays, StepResult
from envs.evaluation import SUCCESS, EvaluationReport, Evaluator
from envs.gym.action_history import ActionHistory
from envs.gym.episodes import IS_SUCCESS
from envs.gym.making import make_vector_env
from envs.gym.parameters import gather
from envs.gym.processes import Message
from envs.gym.settings import GymSettings
from envs.gym.spaces import ActionAdapter, ObservationAdapter
from rewards.gym.transition import GymTransition
from rewards.reward import RewardTerm, fitting, weigh

ADDED_INFOS = ("final_obs", "_final_obs", "final_info", "_final_info")
"""Keys that gymnasium itself adds to the infos of a step in which an episode ends."""

LONGEST_REPLAY_STEPS = 30_000
"""Of an episode that is played again where a run goes on: a game of Atari's still is."""

USUAL_FPS = 30.0
"""Of environments that don't say."""

_logger = logging.getLogger("ventosa")


class GymEvaluator(Evaluator):
    """Judges episodes by their rewards and successes; they are filmed where they are rendered."""

    def pictures(self) -> EvaluationReport:
        """None; see `GymEnvironment.film`."""
        raise ValueError(
            "the environment renders nothing: write environment.kwargs.render_mode=rgb_array "
            "behind the policy, and episodes are filmed"
        )


class GymEnvironment(Environment):
    """N environments of gymnasium. See `Environment`.

    A state to go on from is the number of each environment's episode, which gives its seed, and its
    actions so far: what happened is played again. That is exact where an environment draws
    everything from gymnasium's `np_random` and keeps nothing from one episode to the next; where it
    is not, a warning is logged. The actions of an episode of over `LONGEST_REPLAY_STEPS` are given
    up, as it may never end: the next one begins in its place, after a warning, too.

    Its parameters are those that the environment declares, or attributes of it: see
    `envs.gym.parameters`.

    Args:
        settings: which environment.
        rewards: the terms whose weighted sum is the reward; none: it is the environment's own.
        seed: of everything that is drawn.

    Raises:
        ValueError: there is no such environment, it can't be made, or it does not fit.
    """

    Settings = GymSettings
    snapshot: ClassVar[type[GymTransition]] = GymTransition
    state_axes: ClassVar[Mapping[str, Any]] = {
        "begun": 0,
        "lengths": 0,
        "actions": 1,
        "observations": 0,
        "parameters": 0,
    }

    def __init__(self, settings: GymSettings, rewards: Sequence[RewardTerm[Any]], seed: int = 0):
        self._rewards = fitting(rewards, self.snapshot)
        self.name, self._seed = settings.id, seed
        self.num_envs = settings.num_envs
        self._begun = np.zeros(self.num_envs, np.int64)
        self._first, self._parameters = 0, dict[str, ParameterValue]()
        self._vector = make_vector_env(
            settings, seed, with_infos=bool(rewards), prepare=self._next_episodes
        )
        try:
            self._observe = ObservationAdapter(
                self._vector.single_observation_space, settings.channels, settings.frame_stack
            )
            self._act = ActionAdapter(self._vector.single_action_space)
        except ValueError:
            self.close()
            raise
        self.single_observation_space = self._observe.space
        self.single_action_space = self._act.space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        if settings.kwargs.get("render_mode") == "rgb_array":
            self.frames_per_second = float(self._vector.metadata.get("render_fps", USUAL_FPS))
        self._lengths = np.zeros(self.num_envs, np.int64)
        # As many steps as the longest episode has that can be played again, at least.
        self._history = ActionHistory(self.action_space.shape or (), self.action_space.dtype)
        self._observations: ObservationArrays = {}
        self._tells_success = False  # no episode that did has ended yet
        self.parameter_names = self._call("known_parameters")[0]
        self._has_parameters = False  # none is set yet

    @classmethod
    def imports(cls, settings: BaseModel) -> tuple[str, ...]:
        """See `Environment.imports`."""
        assert isinstance(settings, GymSettings)
        module, colon, _ = settings.id.partition(":")
        return (module,) if colon else ()

    def number_from(self, first: int) -> None:
        """See `Environment.number_from`."""
        self._first = first
        self._call("number_from", first)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationArrays, dict[str, Any]]:
        """Begins new episodes everywhere.

        Raises:
            ValueError: there are options: an episode begun with them could not be played again.
        """
        if options:
            raise ValueError(f"options {options} are not supported")
        if seed is not None:
            self._seed = int(seed)
            self._begun[:] = 0
            self._call("count_from", self._seed, self._begun)
        observations, _ = self._guarded(self._vector.reset)
        self._begun += 1
        self._lengths[:] = 0
        self._history.keep(0)
        self._observations = self._observe(observations)
        return self._observations, {}

    def step(self, actions: NDArray[Any]) -> StepResult:
        """Steps every environment.

        Raises:
            EnvironmentFailure: one of them raised an error, or its process died.
        """
        actions, before = self._act(actions), self._observations
        # A copy: an environment may write to what it is given, and so may a reward.
        observations, reward, terminated, truncated, gathered = self._guarded(
            self._vector.step, actions.copy()
        )
        self._history.append(actions)
        self._lengths += 1
        if len(self._history.actions) > LONGEST_REPLAY_STEPS:
            self._history.keep(self._longest_replay())
        self._observations = self._observe(observations)
        infos = self._end_episodes(terminated | truncated, before, gathered)
        if self._rewards:
            transition = GymTransition(
                observations=before,
                next_observations=_before_reset(self._observations, infos),
                actions=actions,
                rewards=reward,
                terminated=terminated,
                truncated=truncated,
                infos={name: given for name, given in gathered.items() if name not in ADDED_INFOS},
            )
            infos["reward_terms"] = terms = weigh(self._rewards, transition, self.num_envs)
            reward = sum(terms.values(), np.zeros(self.num_envs))
        return self._observations, reward, terminated, truncated, infos

    def set_parameters(self, parameters: Mapping[str, ParameterValue]) -> None:
        """See `Environment.set_parameters`."""
        super().set_parameters(parameters)
        self._parameters = dict(parameters)
        self._call("set_parameters", self._parameters)
        self._has_parameters |= bool(parameters)

    def state_dict(self) -> dict[str, Any]:
        """See `Environment.state_dict`."""
        self._history.keep(self._longest_replay())
        drawn = self._call("drawn_parameters") if self._has_parameters else []
        return {
            "seed": self._seed,
            "begun": self._begun.copy(),
            "lengths": self._lengths.copy(),
            "actions": self._history.actions,
            "observations": self._observations,
            "tells_success": self._tells_success,
            "parameters": gather(drawn),
        }

    def load_state_dict(self, state: dict[str, Any]) -> ObservationArrays:
        """See `Environment.load_state_dict`; plays the running episodes again.

        Raises:
            ValueError: the state has other actions than those of its episodes, or parameters that
                the environment does not have.
        """
        self._check(state)
        self._seed = state["seed"]
        self._begun, self._lengths = state["begun"].copy(), state["lengths"].copy()
        self._history.load(state["actions"])
        self._tells_success = state.get("tells_success", False)
        endless = self._lengths > len(state["actions"])
        self._pass_over(endless)
        self._call("count_from", self._seed, self._begun - 1)
        drawn = {
            name: np.where(endless, np.nan, values)
            for name, values in state.get("parameters", {}).items()
        }
        played = self._call("play", drawn, self._lengths, state["actions"])
        self._observations = self._observe(self._stacked(played))
        if not _equal(self._observations, state["observations"], ~endless):
            _logger.warning(
                "the environment %r did not come back to where it was: played again, its episodes "
                "go another way, so this run goes on well, but not exactly",
                self.name,
            )
        return self._observations

    def _check(self, state: dict[str, Any]) -> None:
        """Refuses a state of which nothing can be played; see `load_state_dict`."""
        begun, lengths, actions = state["begun"], state["lengths"], state["actions"]
        if not begun.shape == lengths.shape == actions.shape[1:2] == (self.num_envs,):
            raise ValueError(f"it was saved with {len(begun)} environments, not {self.num_envs}")
        longest = lengths.max(initial=0, where=lengths <= LONGEST_REPLAY_STEPS)
        if begun.min() < 1 or lengths.min() < 0 or longest > len(actions):
            raise ValueError(
                f"episodes {begun} of {lengths} steps, where {len(actions)} have actions"
            )
        parameters = state.get("parameters", {})
        if unknown := sorted(parameters.keys() - self.parameter_names):
            raise ValueError(f"parameters {unknown}, which the environment does not have")
        if any(values.shape != (self.num_envs,) for values in parameters.values()):
            raise ValueError(f"not one value for each of {self.num_envs} environments: parameters")

    def evaluator(self) -> Evaluator:
        """See `Environment.evaluator`."""
        return GymEvaluator()

    def film(self, rows: Collection[int]) -> None:
        """See `Environment.film`."""
        self._call("film", tuple(rows))

    def pop_frames(self) -> dict[int, list[NDArray[np.uint8]]]:
        """See `Environment.pop_frames`."""
        return {row: frames for row, frames in enumerate(self._call("pop_frames")) if frames}

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the environments."""
        try:
            self._vector.close()
        except Exception as error:  # foreign code, of which nothing is needed any more
            _logger.warning(
                "the environment %r did not close: %s: %s", self.name, type(error).__name__, error
            )

    def _next_episodes(self) -> list[Message]:
        """What an environment that was started again is asked, to go on with its next episode."""
        return [
            ("number_from", (self._first,)),
            ("count_from", (self._seed, self._begun)),
            ("set_parameters", (self._parameters,)),
        ]

    def _end_episodes(
        self, done: NDArray[np.bool_], before: ObservationArrays, gathered: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Counts the episodes that ended, (N,); infos that tell of them, empty where none did."""
        if not done.any():
            return {}
        self._begun[done] += 1
        self._lengths[done] = 0
        self._history.keep(self._longest_replay())
        final = self._final(before, gathered)
        return {"final_obs": final, "_final_obs": done, **self._success(gathered, done)}

    def _longest_replay(self) -> int:
        """Steps of the longest running episode that can be played again."""
        return int(self._lengths.max(initial=0, where=self._lengths <= LONGEST_REPLAY_STEPS))

    def _pass_over(self, endless: NDArray[np.bool_]) -> None:
        """Takes the next episodes in the place of some (N,) that can't be played again."""
        if not endless.any():
            return
        self._begun[endless] += 1
        self._lengths[endless] = 0
        _logger.warning(
            "the episodes of %d of %d environments %r were longer than %d steps, so that their "
            "actions were not kept: they begin new ones, so this run goes on well, but not exactly",
            endless.sum(),
            self.num_envs,
            self.name,
            LONGEST_REPLAY_STEPS,
        )

    def _success(self, gathered: Mapping[str, Any], done: NDArray[np.bool_]) -> dict[str, Any]:
        """Success of the episodes that ended, (N,), where the environment tells it.

        Some tell nothing of an episode that is none: once one is known, the others are not.
        """
        self._tells_success |= IS_SUCCESS in gathered
        if not self._tells_success:
            return {}
        success = np.zeros(self.num_envs, bool)
        told = done & gathered.get(f"_{IS_SUCCESS}", False)
        success[told] = [bool(value) for value in gathered.get(IS_SUCCESS, success)[told]]
        return {"episode_metrics": {SUCCESS.metric: success}}

    def _final(self, before: ObservationArrays, gathered: Mapping[str, Any]) -> ObservationArrays:
        """Last observations (N, ...), right where episodes ended.

        Those of an episode whose process was lost are the ones before its last step.
        """
        final = {name: values.copy() for name, values in before.items()}
        told = gathered.get("_final_obs")
        if told is not None:
            ended = self._observe(self._stacked(list(gathered["final_obs"][told])))
            for name, values in ended.items():
                final[name][told] = values
        return final

    def _stacked(self, observations: Sequence[Any]) -> Any:
        """Observations of k environments as gymnasium batches them."""
        space = self._vector.single_observation_space
        out: Any = create_empty_array(space, len(observations))
        return concatenate(space, observations, out)

    def _call(self, method: str, *arguments: Any) -> Any:
        return self._guarded(self._vector.call, method, *arguments)

    def _guarded(self, function: Any, *arguments: Any) -> Any:
        """Calls the environments; what gymnasium can't put together is a failure, too."""
        try:
            return function(*arguments)
        except EnvironmentFailure:
            raise
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".removesuffix(": ")
            raise EnvironmentFailure(f"the environment {self.name!r} failed: {reason}") from error


def _before_reset(observations: ObservationArrays, infos: Mapping[str, Any]) -> ObservationArrays:
    """Observations (N, ...) after a step; where an episode ended, its last ones."""
    if not infos:
        return observations
    done, final = infos["_final_obs"], infos["final_obs"]
    last = {name: values.copy() for name, values in observations.items()}
    for name, values in last.items():
        values[done] = final[name][done]
    return last


def _equal(first: ObservationArrays, second: ObservationArrays, where: NDArray[np.bool_]) -> bool:
    """Whether observations (N, ...) are the same in some environments (N,)."""
    return first.keys() == second.keys() and all(
        np.array_equal(values[where], second[name][where]) for name, values in first.items()
    )
