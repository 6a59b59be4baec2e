"""The contract of an environment: a batch of environments that training can steer and resume."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from pydantic import BaseModel

from curricula.samplers import ParameterValue
from envs.deployment import Deployment
from envs.evaluation import EvaluationOption, Evaluator
from rewards.reward import RewardTerm

ObservationArrays = dict[str, NDArray[Any]]
"""Arrays (N, ...) by the observations' names."""
StepResult = tuple[ObservationArrays, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]
"""Observations, rewards (N,), terminated (N,), truncated (N,) and infos."""


class EnvironmentFailure(RuntimeError):  # noqa: N818 - gymnasium's Error says something else
    """An environment broke down, through no fault of the run file: a process died, for instance."""


class Environment(VectorEnv[ObservationArrays, NDArray[Any], NDArray[Any]], ABC):
    """N environments stepped together, with dictionaries of observations.

    It resets an environment in the step its episode ends in (`AutoresetMode.SAME_STEP`). The
    `infos` of a step may hold, next to gymnasium's own keys:

    - `final_obs`: observations (N, ...) before the reset, right where `_final_obs` (N,) is set.
    - `same_frame` (N,): the images of the observation are those of the step before, so that they
      need be neither stored nor encoded again.
    - `reward_terms`: the weighted rewards (N,) by name.
    - `episode_metrics`: by name, what to report of an episode (N,), read where it ends. `success`
      among them is the success rate. Where the evaluator `judges_first_action`, they are read after
      the first action too, of episodes that go on.

    Arrays that were handed out, observations above all, are not written to afterwards.

    Built as `cls(settings, rewards, seed)`.

    Attributes:
        name: which environment it is, for messages, where its type does not say that.
        Settings: the model of the run file's `environment` section.
        snapshot: the type of what its rewards are computed from; its constructor gives the rewards
            to `rewards.reward.fitting`, which refuses those for another one.
        pays_by_itself: whether it has a reward of its own, where a run lists none.
        parameter_names: the environment parameters that curricula and samplers may set. They may be
            of the class or of the instance.
        privileged: names of observations that only a critic may see: a policy does not, unless the
            run file says so. They may be of the class or of the instance.
        state_axes: which axis of the state's arrays has an entry for each environment, by the names
            in `state_dict`; all else in it is of them all. Declared by those that know
            `number_from`.
        evaluation_episodes: how many an evaluation plays unless it is told otherwise.
        evaluation_options: what `trainers.evaluate` offers for it, next to its own options.
        tags: what each of its episode metrics says, by TensorBoard tag, for the reference.
        frames_per_second: at which its episodes can be filmed, see `film`; 0: they can't be.
    """

    name: str = ""
    Settings: ClassVar[type[BaseModel]]
    snapshot: ClassVar[type] = object
    pays_by_itself: ClassVar[bool] = True
    parameter_names: frozenset[str] = frozenset()
    privileged: frozenset[str] = frozenset()
    state_axes: ClassVar[Mapping[str, Any]] = {}
    evaluation_episodes: ClassVar[int] = 100
    evaluation_options: ClassVar[tuple[EvaluationOption, ...]] = ()
    tags: ClassVar[Mapping[str, str]] = {}
    frames_per_second: float = 0.0
    single_observation_space: gymnasium.spaces.Dict
    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    @abstractmethod
    def __init__(self, settings: BaseModel, rewards: Sequence[RewardTerm[Any]], seed: int):
        """Builds N environments.

        Raises:
            ValueError: the settings don't fit together, or the rewards don't apply here.
        """

    @classmethod
    def deployment(cls, settings: BaseModel) -> Deployment:
        """What policies are used by away from the environment; nothing need be declared."""
        return Deployment()

    @classmethod
    def harder(cls, settings: BaseModel) -> Mapping[str, BaseModel]:
        """Settings of tasks that policies are not trained for, by what is harder in them.

        They have the same observations and actions; `trainers.calibrate` learns from them when
        policies should be unsure. One that can't be had, with a ValueError when it is reset, is
        left out there. Nothing need be declared.
        """
        return {}

    @classmethod
    def imports(cls, settings: BaseModel) -> tuple[str, ...]:
        """Modules that the settings name, and that building it imports.

        Where the settings came with a stranger's policy, the user is asked first. None need be
        declared that is imported whatever the settings say.
        """
        return ()

    def number_from(self, first: int) -> None:
        """Says that the environments are those with the numbers `first` on of a run's.

        A run in several processes gives each its share. What one of its environments draws may then
        depend on the seed, its number and what it was through, and not on those beside it. Called
        before the first reset.

        Raises:
            NotImplementedError: they can't be divided.
        """
        raise NotImplementedError

    def set_parameters(self, parameters: Mapping[str, ParameterValue]) -> None:
        """Sets environment parameters; they hold from each environment's next reset on."""
        if unknown := sorted(set(parameters) - self.parameter_names):
            raise ValueError(
                f"unknown environment parameters {unknown}; there are: "
                f"{sorted(self.parameter_names) or 'none'}"
            )

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly as from here: plain values and arrays."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> ObservationArrays:
        """Goes back to a state; returns the observations it was left with."""
        raise NotImplementedError

    def film(self, rows: Collection[int]) -> None:
        """Takes a frame of these environments now and after each step, and none of the others."""
        raise NotImplementedError

    def pop_frames(self) -> dict[int, list[NDArray[np.uint8]]]:
        """Frames (H, W, 3) since the last call, oldest first, by the rows that are filmed.

        The last of an episode is there before the next begins, of which there is none.
        """
        raise NotImplementedError

    def evaluator(self) -> Evaluator:
        """Rules by which policies are judged; an environment with none of its own keeps these."""
        return Evaluator()
