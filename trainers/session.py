"""A run's parts, wired together from its settings."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from gymnasium.spaces import Box
from torch import Tensor

from curricula.curriculum import Curriculum, FinishedEpisodes, State
from curricula.samplers import ParameterValue
from encoders.spaces import bounded
from envs.environment import Environment
from envs.memory import shortage
from rewards.reward import RewardTerm
from trainers.algorithms.base import Algorithm
from trainers.common.devices import resolve_device
from trainers.common.errors import UserError, suggestion
from trainers.distributed.states import Axes, on_cpu
from trainers.distributed.world import ALONE, World
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import EpisodeBatch
from trainers.experience.frames import frame_spaces
from trainers.inference.construction import network_factory
from trainers.inference.first_pass import check_first_pass
from trainers.inference.metadata import Metadata
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import is_image
from trainers.reporting.summary import RunPosition
from trainers.runfile.registry import Registries
from trainers.runfile.settings import Component, RunSettings
from trainers.saving.resumable import ALGORITHM, Resumable

_logger = logging.getLogger("ventosa")

BYTES_PER_PARAMETER = 16
"""A weight, its gradient and Adam's two moments, in float32."""


class Session:
    """Everything that acts in a run, and the state it goes on from.

    Args:
        run: the settings.
        registries: where the default encoders are found.
        stop_requested: asked before every step of the environments.
        world: the processes of the run, of which each has such a session.

    Attributes:
        env_runner: the environments.
        algorithm: learns from them.
        curriculum: None where the run has none.
        metadata: what the run's policies say of themselves.

    Raises:
        UserError: the settings don't fit each other.
    """

    def __init__(
        self,
        run: RunSettings,
        registries: Registries,
        stop_requested: Callable[[], bool] = lambda: False,
        world: World = ALONE,
    ):
        device = resolve_device(world.device(run.device))
        self._check_first_pass = partial(check_first_pass, run=run, registries=registries)
        self.world = world
        self.curriculum = build_curriculum(run)
        self._parameters = run.environment_parameters
        self._curriculum_state: State = (
            self.curriculum.initial_state() if self.curriculum is not None else {}
        )
        env = build_environment(own_part(run, world), run.seed)
        try:
            _number(run, env, world)
            self._check_parameters(env)
            _warn_of_what_learns_badly(run, env)
            factory = build_factory(run, registries, env)
            _check_network_size(run, factory)
            torch.manual_seed(run.seed)
            generator = torch.Generator(device).manual_seed(run.seed)
            self.env_runner = EnvRunner(env, stop_requested, world)
            self.metadata = Metadata.of_run(run, registries, env)
            self.algorithm: Algorithm = run.trainer.cls(
                factory, run.trainer.settings, self.env_runner, generator, device
            )
            with blaming_parameters():
                # Those of all lessons first, so that they are not refused hours later.
                for parameters in (*self._lessons_ahead(), self._parameters_now()):
                    self.env_runner.set_parameters(parameters)
        except BaseException:
            env.close()
            raise

    @property
    def lesson(self) -> int:
        """The present lesson, from 0."""
        return 0 if self.curriculum is None else self.curriculum.lesson(self._curriculum_state)

    @property
    def lesson_count(self) -> int:
        """Lessons of the curriculum; 1 without one."""
        return 1 if self.curriculum is None else self.curriculum.lesson_count

    @property
    def lesson_title(self) -> str:
        """The present lesson for people: "lesson 3 of 19", and its name if it has one."""
        title = f"lesson {self.lesson + 1} of {self.lesson_count}"
        name = self.curriculum and self.curriculum.lesson_name(self._curriculum_state)
        return f"{title} ({name})" if name else title

    @property
    def position(self) -> RunPosition:
        """Position of the run."""
        lesson = None if self.curriculum is None else self.lesson
        return RunPosition(self.env_runner.step_count, lesson, self.lesson_count)

    def reset(self) -> None:
        """Begins the run's first episodes, and passes what they show through the networks once.

        Raises:
            UserError: there can be none with the environment's settings; or what a plugin gives is
                not what it says.
            PluginFailure: a plugin's network fails.
        """
        try:
            self.env_runner.reset()
        except ValueError as error:
            raise UserError(f"environment: {error}") from error
        self._check_first_pass(
            self.algorithm.policy, self.env_runner.env, self.env_runner.observations
        )

    def advance_curriculum(self, episodes: EpisodeBatch, run_fraction: float) -> bool:
        """Shows finished episodes to the curriculum; True if a new lesson begins.

        Args:
            episodes: those of earlier lessons, whose parameters they began with, are passed over.
            run_fraction: how much of the run is over, in [0, 1].
        """
        if self.curriculum is None:
            return False
        before = self.lesson
        own = episodes[episodes.number >= self.env_runner.parameters_from]
        finished = FinishedEpisodes(own.rewards, own.successes, run_fraction)
        self._curriculum_state = self.curriculum.advance(self._curriculum_state, finished)
        if self.lesson == before:
            return False
        self.env_runner.set_parameters(self._parameters_now())
        return True

    def resumable(self) -> Resumable:
        """What it can be taken up from; taken between an update and the next collection.

        It may share memory with what updates change: it is of use until the next one.
        """
        return Resumable(self.env_runner.step_count, self.weights(), self.state_dict())

    def weights(self) -> dict[str, Tensor]:
        """The policy's weights."""
        return dict(self.algorithm.policy.state_dict())

    def share_weights(self) -> None:
        """Begins with the first process's: files, and last bits, may differ between machines."""
        if self.world.size > 1:
            own = on_cpu(self.weights())
            self.algorithm.policy.load_state_dict(self.world.first(own))

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights; see `resumable`. Of the environments this process's share."""
        return {
            ALGORITHM: self.algorithm.state_dict(),
            "interaction": self.env_runner.state_dict(),  # checkpoints have always called it so
            "curriculum": self._curriculum_state,
        }

    def load_state_dict(self, weights: dict[str, Tensor], state: Mapping[str, Any]) -> None:
        """Goes back to a state; see `own_state`."""
        self.algorithm.load_state_dict(weights, state[ALGORITHM])
        if self.curriculum is not None:
            self._curriculum_state = state["curriculum"]
        self.env_runner.set_parameters(self._parameters_now())
        self.env_runner.load_state_dict(state["interaction"])

    def joined_state(self, state: Mapping[str, Any]) -> Mapping[str, Any]:
        """The state of all processes, which each of them has one of; it is what is saved."""
        return self.world.state(state, self._state_axes)

    def own_state(self, state: Mapping[str, Any]) -> Mapping[str, Any]:
        """This process's share of a state that was saved, by however many processes.

        Raises:
            ValueError: it is that of another number of environments.
        """
        return self.world.own(state, self._state_axes, self.env_runner.share)

    def close(self) -> None:
        """Ends the environments."""
        self.env_runner.env.close()

    @property
    def _state_axes(self) -> Axes:
        algorithm = getattr(self.algorithm, "state_axes", {})
        return {ALGORITHM: algorithm, "interaction": self.env_runner.state_axes}

    def _parameters_now(self) -> dict[str, ParameterValue]:
        lesson = (
            {} if self.curriculum is None else self.curriculum.parameters(self._curriculum_state)
        )
        return {**self._parameters, **lesson}

    def _lessons_ahead(self) -> Iterator[dict[str, ParameterValue]]:
        """Environment parameters of all lessons, as far as the curriculum tells them."""
        if self.curriculum is None:
            return
        every = getattr(self.curriculum, "all_parameters", None)
        for lesson in every() if every else (self.curriculum.final_parameters(),):
            yield {**self._parameters, **lesson}

    def _check_parameters(self, env: Environment) -> None:
        sources = {"environment_parameters": self._parameters}
        if self.curriculum is not None:
            first = self.curriculum.parameters(self._curriculum_state)
            sources["curriculum"] = {**first, **self.curriculum.final_parameters()}
        for path, parameters in sources.items():
            for name in sorted(set(parameters) - env.parameter_names):
                raise UserError(
                    f"{path}: the environment has no parameter {name!r}; "
                    f"{suggestion(name, env.parameter_names)}"
                )


def _check_network_size(run: RunSettings, factory: NetworkFactory) -> None:
    """Refuses networks that the machine has no memory to train, before there are any.

    Raises:
        UserError: with how much they need.
    """
    with torch.device("meta"):  # where parameters have shapes and no values
        try:
            policy = run.trainer.cls.build_policy(factory, run.trainer.settings)
        except RuntimeError:
            return  # a plugin's networks, which look at values as they are built
    count = sum(parameter.numel() for parameter in policy.parameters())
    if lack := shortage(count * BYTES_PER_PARAMETER, "networks and optimizers"):
        raise UserError(
            f"trainer.network_settings and encoders: to train networks with {count:,} parameters "
            f"{lack}: make hidden layers or encoders smaller"
        )


def _warn_of_what_learns_badly(run: RunSettings, env: Environment) -> None:
    """Tells of what a run may do, and hardly anybody wants."""
    if not run.rewards and not env.pays_by_itself:
        _logger.warning(
            "rewards: the run file lists none, and the environment %r has none of its own: every "
            "reward is 0, and nothing is learned",
            run.environment.name,
        )
    for name, space in frame_spaces(env.single_observation_space).items():
        if isinstance(space, Box) and is_image(space) and not bounded(space).all():
            _logger.warning(
                "observation %r: images without bounds are taken as they are: declare bounds in "
                "the environment's space, and they are scaled to [0, 1], as networks need it",
                name,
            )


def own_part(run: RunSettings, world: World) -> RunSettings:
    """The run with no more environments than this process's share.

    Raises:
        UserError: they can't be divided evenly.
    """
    count = getattr(run.environment.settings, "num_envs", 1)
    if count % world.size:
        raise UserError(
            f"environment.num_envs: {count} environments can't be divided among the "
            f"{world.size} ranks evenly: use a multiple of {world.size}, or other ranks "
            "(--nproc-per-node, --nnodes)"
        )
    return run.with_environments(count // world.size)


def _number(run: RunSettings, env: Environment, world: World) -> None:
    """Says to environments which of the run's they are.

    Raises:
        UserError: there are several processes, and environment or algorithm are not made for that.
    """
    if world.size > 1 and not hasattr(run.trainer.cls, "state_axes"):
        raise UserError(
            f"trainer: {run.trainer.name!r} does not say how it runs in several processes "
            "(state_axes): run it in one, without torchrun"
        )
    try:
        env.number_from(world.share(env.num_envs).first)
    except NotImplementedError as error:
        if world.size == 1:
            return
        raise UserError(
            f"environment: {run.environment.name!r} does not say how it is divided among several "
            "processes (number_from): run it in one, without torchrun"
        ) from error


def build_environment(run: RunSettings, seed: int) -> Environment:
    """The run's environments, with its rewards.

    Raises:
        UserError: the settings don't fit together.
    """
    terms = [
        RewardTerm(reward.component.name, reward.weight, _build(reward.component, "rewards"))
        for reward in run.rewards
    ]
    env: Environment = _build(run.environment, "environment", terms, seed)
    return env


def build_curriculum(run: RunSettings) -> Curriculum | None:
    """The run's curriculum, if it has one."""
    if run.curriculum is None:
        return None
    curriculum: Curriculum = _build(run.curriculum, "curriculum")
    return curriculum


def final_parameters(run: RunSettings) -> dict[str, ParameterValue]:
    """Environment parameters of the run's last lesson."""
    curriculum = build_curriculum(run)
    lesson = {} if curriculum is None else curriculum.final_parameters()
    return {**run.environment_parameters, **lesson}


@contextmanager
def blaming_parameters() -> Iterator[None]:
    """Turns an environment's ValueError about parameters into the user's mistake."""
    try:
        yield
    except ValueError as error:
        raise UserError(f"environment_parameters or curriculum: {error}") from error


def _build(component: Component, path: str, *rest: Any) -> Any:
    """Builds a component; what it does not like about its settings is the user's mistake."""
    try:
        return component.cls(component.settings, *rest)
    except ValueError as error:
        raise UserError(f"{path} ({component.name}): {error}") from error


def build_factory(run: RunSettings, registries: Registries, env: Environment) -> NetworkFactory:
    """Factory of the run's networks."""
    return network_factory(
        env.single_observation_space,
        env.single_action_space,
        env.privileged,
        run.encoders,
        registries.encoders,
    )
