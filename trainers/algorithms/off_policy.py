"""Common parts of algorithms that learn from a replay buffer, as DDPG does."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator
from torch import Tensor, nn

from trainers.algorithms.augmentation import RandomShift, unchanged
from trainers.algorithms.base import TrainerSettings
from trainers.algorithms.captured import Captured
from trainers.algorithms.optimization import (
    adam,
    check_finite,
    load_generator,
    load_optimizer,
    optimizer_state,
    optimizer_step,
    set_learning_rates,
)
from trainers.algorithms.schedules import CONSTANT, Schedule
from trainers.common.errors import UserError
from trainers.experience.collector import BehaviorOutput, CollectedStep, Collector
from trainers.experience.env_runner import EnvRunner
from trainers.experience.memory import check_room
from trainers.experience.replay_buffer import ReplayBuffer
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.observations import Observations
from trainers.networks.off_policy_network import OffPolicyNetwork

ACTOR, CRITIC = "actor", "critic"
STEPS = "steps"
"""Name, beside the statistics of a round, of what its optimizer steps said, (steps, 2)."""


class OffPolicyHyperparameters(BaseModel, frozen=True, extra="forbid"):
    """Hyper-parameters of the replay buffer, and of the updates from it."""

    batch_size: int = Field(256, ge=1, description="Transitions in one optimizer step.")
    buffer_size: int = Field(200_000, ge=1, description="Transitions in the replay buffer.")
    buffer_init_steps: int = Field(
        1_000,
        ge=0,
        description="Transitions, of actions drawn uniformly, before the first update.",
    )
    updates_per_step: float = Field(
        1.0,
        gt=0.0,
        le=1000.0,
        description="Updates per transition; with many environments a fraction of 1 is enough.",
    )
    policy_delay: int = Field(
        1,
        ge=1,
        le=1000,
        description="Updates of the critic for each one of the actor and of the targets.",
    )
    learning_rate: float = Field(1e-3, gt=0.0, description="Of the actor, to begin with.")
    critic_learning_rate: float | None = Field(
        None, gt=0.0, description="Of the critic, to begin with; null: the actor's."
    )
    learning_rate_schedule: Schedule = Field(CONSTANT, description="Course of both learning rates.")
    gamma: float = Field(0.99, ge=0.0, le=1.0, description="Discount factor.")
    tau: float = Field(
        0.005, gt=0.0, le=1.0, description="How far the target networks follow in an update."
    )
    n_step: int = Field(
        1, ge=1, le=1000, description="Rewards in a return before the critic takes over."
    )
    random_actions: float = Field(
        0.0, ge=0.0, le=1.0, description="Share of the actions that are drawn uniformly instead."
    )
    random_shift_px: int = Field(
        0,
        ge=0,
        le=4096,
        description="Images are shifted by up to so many pixels at random; 0: never.",
    )
    max_gradient_norm: float | None = Field(
        None, gt=0.0, description="Gradients are clipped to this norm; null: not at all."
    )
    save_replay_buffer: bool = Field(
        False,
        description="Keep the replay buffer in the checkpoints. Without it a run that is resumed "
        "collects buffer_init_steps with its policy before it learns on.",
    )

    @model_validator(mode="after")
    def _fits_in_the_buffer(self) -> OffPolicyHyperparameters:
        for name in ("batch_size", "buffer_init_steps"):
            if getattr(self, name) > self.buffer_size:
                raise ValueError(
                    f"{name} {getattr(self, name)} is over buffer_size {self.buffer_size}: lower "
                    f"{name}, or raise buffer_size"
                )
        return self

    def learning_rates(self, run_fraction: float) -> tuple[float, float]:
        """Those of the actor and of the critic at a point of the run."""
        schedule = self.learning_rate_schedule
        return (
            schedule.value(self.learning_rate, run_fraction),
            schedule.value(self.critic_learning_rate or self.learning_rate, run_fraction),
        )


class OffPolicySettings(TrainerSettings, frozen=True, extra="forbid"):
    """The `trainer` section of a run with an off-policy algorithm."""

    time_horizon: int = Field(
        64, ge=1, description="Steps of each environment between two rounds of updates."
    )
    hyperparameters: OffPolicyHyperparameters


class OffPolicyAlgorithm(ABC):
    """Collects transitions into a replay buffer, and updates from it. Implements `Algorithm`.

    A subclass says how to explore, and how critic and actor improve.

    What is collected waits beside the buffer until the update: the buffer, like the weights, stays
    as it is while the run can still be asked to stop, and its state needs no copy.

    Args:
        policy: on the device.
        settings: how to collect, and the hyper-parameters.
        parameters: what is learned, by the name of its optimizer; `critic` has a learning rate of
            its own.
        env_runner: the environments.
        generator: the source of all randomness.
        device: where the policy lives.

    A subclass may use its arguments `policy`, `_settings`, `_parameters`, `_env_runner`,
    `_generator` and `_device`, and these attributes.

    Attributes:
        _hyperparameters: of the settings; a subclass annotates its own type.
        _buffer: the transitions, up to the last update.
        _seen: names of the observations that the actor or a critic sees.
        _actions_shape: (N, A).
        _augment: to be called on all observations that are learned from.
    """

    tags: ClassVar[Mapping[str, str]] = {
        "Policy/Learning Rate": "Of the policy, as scheduled.",
        "Policy/Critic Learning Rate": "Of the critic, as scheduled.",
    }
    policy: OffPolicyNetwork
    state_size = 0
    _hyperparameters: OffPolicyHyperparameters

    def __init__(
        self,
        policy: OffPolicyNetwork,
        settings: OffPolicySettings,
        parameters: Mapping[str, Sequence[nn.Parameter]],
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        self.policy, self._settings = policy, settings
        self._hyperparameters = hyper = settings.hyperparameters
        self._env_runner, self._generator, self._device = env_runner, generator, device
        self._parameters = parameters
        self._optimizers = {name: adam([part], device) for name, part in parameters.items()}
        env, size = env_runner.env, policy.scale.size
        self._seen = {*policy.sees, *policy.critic_sees}
        self._actions_shape = (env.num_envs, size)
        self.collection_steps = settings.time_horizon * env_runner.num_envs
        self._max_gradient_norm = hyper.max_gradient_norm or float("inf")
        if hyper.random_shift_px and env_runner.world.size > 1:
            raise UserError(
                "trainer.hyperparameters.random_shift_px: how images are shifted is drawn in one "
                "process alone: set it to 0, or run without torchrun"
            )
        check_room(env, settings.time_horizon, "trainer.time_horizon")
        capacity = -(-hyper.buffer_size // env_runner.num_envs) * env.num_envs
        self._buffer = ReplayBuffer(
            env.single_observation_space, size, env.num_envs, capacity, device
        )
        self._augment = (
            RandomShift(hyper.random_shift_px, generator) if hyper.random_shift_px else unchanged
        )
        self._collector: Collector[Tensor] = Collector(self, env_runner, device)
        self._collected: list[CollectedStep[Tensor]] = []
        self._pending_updates = 0.0  # asked for by transitions, and not made yet
        self._steps_taken: list[Tensor] = []  # in this round
        self._weight = 1.0  # of one's own transitions among those of a minibatch
        self._improve = self._captured()

    # -- the subclass's --------------------------------------------------------------------------

    @abstractmethod
    def _explore(self, observations: Observations, features: FrameFeatures) -> Tensor:
        """Actions (N, A) in [-1, 1], with what the algorithm explores by."""

    @abstractmethod
    def _improve_critic(self, indices: Tensor) -> dict[str, Tensor]:
        """One optimizer step of the critic on transitions (B,); statistics by TensorBoard tag."""

    @abstractmethod
    def _improve_actor(self, indices: Tensor) -> dict[str, Tensor]:
        """One optimizer step of the actor on transitions (B,); statistics by TensorBoard tag.

        Both are captured, see `Captured`: they read nothing back from the device.
        """

    def _episodes_ended(self, done: NDArray[np.bool_]) -> None:  # noqa: B027 - may stay empty
        """Called after every step with (N,), for exploration with a state."""

    # -- collecting ------------------------------------------------------------------------------

    @torch.no_grad()
    def collect(self) -> None:
        """See `Algorithm.collect`."""
        self._collected = []
        self._collector.begin()
        with self._env_runner.world.together():
            for _ in range(self._settings.time_horizon):
                # No frame is kept here: the buffer has each once.
                step = self._collector.collect_step(self._collector.frame_store(1))
                self._collected.append(step)
                self._episodes_ended(step.step.done)

    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """See `collector.Behavior.encode_frames`."""
        return self.policy.encode_frames(frames)

    def act(self, observations: Observations, features: FrameFeatures) -> BehaviorOutput[Tensor]:
        """See `collector.Behavior.act`; the output is the actions (N, A) in [-1, 1]."""
        hyper, hidden_state = self._hyperparameters, self._collector.hidden_state
        random = 2.0 * self._uniform(self._actions_shape) - 1.0
        if self._env_runner.step_count < hyper.buffer_init_steps:
            return BehaviorOutput(self.policy.scale(random), hidden_state, random)
        explored = self._explore(observations, features)
        drawn = self._uniform((self._actions_shape[0], 1)) < hyper.random_actions
        actions = torch.where(drawn, random, explored)
        return BehaviorOutput(self.policy.scale(actions), hidden_state, actions)

    def _uniform(self, shape: tuple[int, int]) -> Tensor:
        """Numbers from 0 to 1."""
        return self._env_runner.share.drawn(
            torch.rand, shape, generator=self._generator, device=self._device
        )

    # -- learning --------------------------------------------------------------------------------

    def update(self, run_fraction: float) -> Mapping[str, float]:
        """See `Algorithm.update`."""
        if not self._collected:
            raise RuntimeError("update() comes after collect()")
        scheduled = self._schedule(run_fraction)
        self._store_collected()
        hyper = self._hyperparameters
        if len(self._buffer) * self._env_runner.world.size >= hyper.buffer_init_steps:
            self._pending_updates += self.collection_steps * hyper.updates_per_step
        rounds, self._pending_updates = divmod(self._pending_updates, hyper.policy_delay)
        if not rounds:
            return scheduled
        drawn = (int(rounds), hyper.policy_delay, hyper.batch_size)
        statistics = []
        for indices in self._buffer.sample(drawn, self._generator, self._env_runner.num_envs):
            self._env_runner.check_stop()
            statistics.append(self._improve(indices))
        return self._means(statistics) | scheduled

    def _means(self, statistics: Sequence[dict[str, Tensor]]) -> dict[str, float]:
        """Means of the rounds' statistics.

        Raises:
            NonFiniteError: a loss was NaN or infinite, or its gradient.
        """
        # All at once: on an accelerator what is read waits for all that is under way.
        for step in torch.cat([each.pop(STEPS) for each in statistics]).tolist():
            check_finite(step, self._env_runner.step_count)
        means = torch.stack([torch.stack(tuple(each.values())) for each in statistics]).mean(dim=0)
        (means,) = self._env_runner.mean([means], 1.0)
        return dict(zip(statistics[0], means.tolist(), strict=True))

    def _schedule(self, run_fraction: float) -> dict[str, float]:
        """Sets what changes over the run; returns it by TensorBoard tag."""
        rate, critic_rate = self._hyperparameters.learning_rates(run_fraction)
        for name, optimizer in self._optimizers.items():
            set_learning_rates(optimizer, [critic_rate if name == CRITIC else rate])
        return {"Policy/Learning Rate": rate, "Policy/Critic Learning Rate": critic_rate}

    def _improve_all(self, indices: Tensor) -> dict[str, Tensor]:
        """Updates the critic once for each of (policy_delay, B), then the actor and the targets."""
        self._steps_taken = []
        for each in indices:
            own, self._weight = self._env_runner.share.own(each)
            statistics = self._improve_critic(own)
        statistics |= self._improve_actor(own)
        self.policy.update_targets()
        detached = {name: self._weight * value.detach() for name, value in statistics.items()}
        return detached | {STEPS: torch.stack(self._steps_taken)}

    def _captured(self) -> Callable[[Tensor], dict[str, Tensor]]:
        """`_improve_all`, in a graph where nothing has to be told to other processes meanwhile."""
        if self._env_runner.world.size > 1:
            return self._improve_all
        return Captured(self._improve_all, self._generator, self._device)

    def _store_collected(self) -> None:
        """Moves what was collected to the buffer and to the statistics of the observations.

        Nothing of it is kept: its images would take up memory during all updates.
        """
        collected, self._collected = self._collected, []
        for step in collected:
            actions = step.acted.output.cpu().numpy()
            self._buffer.add(step.observations, actions, step.step, step.next_observations)
        vectors, all_rows = [step.vectors for step in collected], self._env_runner.all_rows
        self.policy.update_statistics(
            {k: all_rows(torch.cat([v[k] for v in vectors])) for k in vectors[0]}
        )

    def _optimizer_step(self, name: str, loss: Tensor) -> None:
        """One step of the optimizer of that name, with clipped gradients, if all is finite."""
        optimizer, parameters = self._optimizers[name], self._parameters[name]
        world = self._env_runner.world
        mean = partial(world.mean, weight=self._weight)
        step = optimizer_step(
            optimizer, loss, parameters, self._max_gradient_norm, mean, alone=world.size == 1
        )
        self._steps_taken.append(step)

    # -- the state -------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """See `Algorithm.state_dict`."""
        saved = self._hyperparameters.save_replay_buffer
        return {
            **{
                f"{name}_optimizer": optimizer_state(each)
                for name, each in self._optimizers.items()
            },
            "generator": self._generator.get_state(),
            "due": self._pending_updates,  # checkpoints have always called it so
            "replay_buffer": self._buffer.state_dict() if saved else None,
        }

    def load_state_dict(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """See `Algorithm.load_state_dict`."""
        if state["replay_buffer"] is not None:
            self._buffer.load_state_dict(state["replay_buffer"])
        self.policy.load_state_dict(weights)
        for name, optimizer in self._optimizers.items():
            load_optimizer(optimizer, state[f"{name}_optimizer"])
        load_generator(self._generator, state["generator"])
        self._pending_updates = state["due"]
        self._improve = self._captured()
