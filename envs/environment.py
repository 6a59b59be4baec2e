"""The contract of an environment: a batch of environments that training can steer and resume."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from pydantic import BaseModel

from curricula.samplers import ParameterValue
from rewards.reward import RewardTerm

Observations = dict[str, NDArray[Any]]
StepResult = tuple[Observations, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]
"""Observations, rewards (N,), terminated (N,), truncated (N,) and infos."""


class EnvironmentFailure(RuntimeError):  # noqa: N818 - gymnasium's Error says something else
    """An environment broke down, through no fault of the run file: a process died, for instance."""


class PhysicalCheck(Protocol):
    """Carries out actions in a world with full physics, apart from the episodes."""

    def __call__(self, actions: NDArray[Any]) -> dict[str, NDArray[np.bool_]]:
        """Tries out actions (n, ...) in the first n environments, whose episodes do not notice.

        Returns:
            By name (n,): `success`, and each reason of failure; one of them is true of every row.
        """

    def close(self) -> None:
        """Frees what it holds; calling it twice does no harm."""


class EvaluationReport(Protocol):
    """Pictures of a policy's actions, for people to look at.

    Attributes:
        file_names: what `files` makes.
    """

    file_names: tuple[str, ...]

    def add(self, actions: NDArray[Any], outcomes: Mapping[str, NDArray[np.bool_]]) -> None:
        """Takes up actions (n, ...) in the first n environments, before they are carried out.

        Args:
            actions: those of the policy.
            outcomes: what the physical check says of them; empty where there was none.
        """

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Draws everything: names and contents of files."""


class Environment(VectorEnv[Observations, NDArray[Any], NDArray[Any]]):
    """N environments stepped together, with dictionaries of observations.

    It resets an environment in the step its episode ends in (`AutoresetMode.SAME_STEP`). The
    `infos` of a step may hold, next to gymnasium's own keys:

    - `final_obs`: observations (N, ...) before the reset, right where `_final_obs` (N,) is set.
    - `same_frame` (N,): the images of the observation are those of the step before, so that they
      need be neither stored nor encoded again.
    - `reward_terms`: the weighted rewards (N,) by name.
    - `episode_metrics`: by name, what to report of an episode (N,), read where it ends. `success`
      among them is the success rate.

    Arrays that were handed out, observations above all, are not written to afterwards.

    Built as `cls(settings, rewards, seed)`.

    Attributes:
        Settings: the model of the run file's `environment` section.
        snapshot: the type of what its rewards are computed from; its constructor gives the rewards
            to `rewards.reward.fitting`, which refuses those for another one.
        parameter_names: the environment parameters that curricula and samplers may set.
        privileged: names of the observations that only a critic may see.
        evaluation_episodes: how many an evaluation plays unless it is told otherwise.
    """

    Settings: ClassVar[type[BaseModel]]
    snapshot: ClassVar[type] = object
    parameter_names: ClassVar[frozenset[str]] = frozenset()
    privileged: frozenset[str] = frozenset()
    evaluation_episodes: ClassVar[int] = 100
    single_observation_space: gymnasium.spaces.Dict
    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    @abstractmethod
    def __init__(self, settings: BaseModel, rewards: Sequence[RewardTerm[Any]], seed: int):
        """Builds N environments.

        Raises:
            ValueError: the settings don't fit together, or the rewards don't apply here.
        """

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

    def load_state_dict(self, state: dict[str, Any]) -> Observations:
        """Goes back to a state; returns the observations it was left with."""
        raise NotImplementedError

    def physical_check(self, *, window: bool = False) -> PhysicalCheck:
        """What evaluation tries out first actions in; an environment need not have it.

        Args:
            window: show it, as it goes.

        Raises:
            ValueError: it can't be had as asked for.
        """
        raise ValueError("it has no physical check")

    def album(self) -> EvaluationReport:
        """What evaluation has its pictures from; an environment need not have it.

        Raises:
            ValueError: it can't be had: something is not installed, perhaps.
        """
        raise ValueError("it has no pictures to show")
