"""Deep Deterministic Policy Gradient (Lillicrap et al. 2015, arXiv:1509.02971)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from trainers.algorithms.augmentation import RandomShift, unchanged
from trainers.algorithms.base import TrainerSettings
from trainers.algorithms.exploration import GaussianSettings, Noise, NoiseSettings
from trainers.algorithms.optimization import optimizer_step
from trainers.algorithms.schedules import CONSTANT, Schedule
from trainers.common.averager import Averager
from trainers.common.timers import timed
from trainers.experience.env_runner import EnvRunner, Step
from trainers.experience.replay_buffer import ReplayBuffer
from trainers.networks.actor_critic import to_environment, with_rows
from trainers.networks.deterministic import DeterministicPolicy, DeterministicSettings
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import Observations, gather, to_tensors


class DDPGHyperparameters(BaseModel, frozen=True, extra="forbid"):
    """Hyper-parameters of DDPG, with ML-Agents' names where the thing is the same."""

    batch_size: int = Field(256, ge=1, description="Transitions in one step of gradient descent.")
    buffer_size: int = Field(200_000, ge=1, description="Transitions that are remembered.")
    buffer_init_steps: int = Field(
        1_000,
        ge=0,
        description="Transitions, of actions drawn uniformly, before the first update.",
    )
    updates_per_step: float = Field(
        1.0,
        gt=0.0,
        description="Updates per transition; with many environments a fraction of 1 is enough.",
    )
    policy_delay: int = Field(
        1, ge=1, description="Updates of the critic for each one of the actor and of the targets."
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
    n_step: int = Field(1, ge=1, description="Rewards in a return before the critic takes over.")
    noise: NoiseSettings = Field(
        default_factory=GaussianSettings, description="What is added to the actor's actions."
    )
    random_actions: float = Field(
        0.0, ge=0.0, le=1.0, description="Share of the actions that are drawn uniformly instead."
    )
    random_shift_px: int = Field(
        0, ge=0, description="Images are shifted by up to so many pixels at random; 0: never."
    )
    max_gradient_norm: float | None = Field(
        None, gt=0.0, description="Gradients are clipped to this norm; null: not at all."
    )
    save_replay_buffer: bool = Field(
        False,
        description="Keep what is remembered in the checkpoints. Without it a run that is resumed "
        "plays buffer_init_steps with its policy before it learns on.",
    )

    @model_validator(mode="after")
    def _fits_in_the_buffer(self) -> DDPGHyperparameters:
        for name in ("batch_size", "buffer_init_steps"):
            if getattr(self, name) > self.buffer_size:
                raise ValueError(
                    f"{name} {getattr(self, name)} is over buffer_size {self.buffer_size}: lower "
                    f"{name}, or raise buffer_size"
                )
        return self


class DDPGSettings(TrainerSettings, frozen=True, extra="forbid"):
    """The `trainer` section of a run with DDPG."""

    time_horizon: int = Field(
        64, ge=1, description="Steps of each environment between two rounds of updates."
    )
    hyperparameters: DDPGHyperparameters = Field(
        default_factory=DDPGHyperparameters, description="Hyper-parameters of DDPG."
    )
    network_settings: DeterministicSettings = Field(
        default_factory=DeterministicSettings, description="Networks of the actor and the critic."
    )


@dataclass(frozen=True)
class _Moment:
    """One step of N environments."""

    observations: Mapping[str, NDArray[Any]]
    actions: NDArray[np.float32]
    step: Step
    following: Mapping[str, NDArray[Any]]


class DDPG:
    """DDPG from a replay buffer. See `trainers.algorithms.base.Algorithm`.

    What is collected waits beside the buffer until the update: the buffer, like the weights, stays
    as it is while the run can still be asked to stop, and its state needs no copy.
    """

    Settings = DDPGSettings

    def __init__(
        self,
        factory: NetworkFactory,
        settings: DDPGSettings,
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        self._settings, self._hyperparameters = settings, settings.hyperparameters
        self._env_runner, self._generator, self._device = env_runner, generator, device
        hyper, env = settings.hyperparameters, env_runner.env
        self.policy = DeterministicPolicy(factory, settings.network_settings, hyper.tau).to(device)
        online = self.policy.online
        self._actor_parameters = online.actor_parameters()
        self._critic_parameters = online.critic_parameters()
        self._seen = {*online.actor_sees, *online.critic_sees}
        self._actor_optimizer = torch.optim.Adam(self._actor_parameters, fused=True)
        self._critic_optimizer = torch.optim.Adam(self._critic_parameters, fused=True)
        self._max_gradient_norm = hyper.max_gradient_norm or float("inf")
        self._shape = (env.num_envs, int(np.prod(factory.action_space.shape or ())))
        self._noise: Noise = hyper.noise.build(self._shape, device)
        self._buffer = ReplayBuffer(
            env.single_observation_space, self._shape[1], env.num_envs, hyper.buffer_size, device
        )
        self._augment = (
            RandomShift(hyper.random_shift_px, generator) if hyper.random_shift_px else unchanged
        )
        # Without a future there is no value to estimate, nor anything to look at.
        self._targets = self._bootstrapped_returns if hyper.gamma else self._buffer.rewards
        self._pending_updates = 0.0  # updates that were asked for by transitions, and not made yet
        self._moments: list[_Moment] = []
        self._features: Tensor | None = None  # what the actor makes of the frames in view, (N, f)
        self._new = np.arange(0)  # where the frame came into view with the last step

    def initial_state(self, count: int) -> Tensor:
        """See `Algorithm.initial_state`; nothing is remembered."""
        return torch.zeros(count, 0, device=self._device)

    @torch.no_grad()
    def act(self, observations: Observations, *, deterministic: bool) -> tuple[Tensor, Tensor]:
        """See `Algorithm.act`; what is drawn has the noise of the run's end.

        No action is replaced by one of `random_actions`: those are drawn for the buffer's sake and
        say nothing of the policy.
        """
        actions = self.policy.online.act(observations)
        if not deterministic:
            sigma = self._sigma(1.0) * self._hyperparameters.noise.deviation()
            noise = torch.randn(actions.shape, generator=self._generator, device=actions.device)
            actions = (actions + sigma * noise).clamp(-1.0, 1.0)
        return self.policy.to_space(actions), self.initial_state(len(actions))

    @torch.no_grad()
    def collect(self) -> None:
        """See `Algorithm.collect`."""
        self._moments, self._features = [], None
        for _ in range(self._settings.time_horizon):
            self._moments.append(self._play())

    def update(self, progress: float) -> Mapping[str, float]:
        """See `Algorithm.update`."""
        moments, self._moments = self._moments, []
        if not moments:
            raise RuntimeError("update() comes after collect()")
        schedules = self._set_schedules(progress)
        self._remember(moments)
        averager = Averager()
        if len(self._buffer) >= self._hyperparameters.buffer_init_steps:
            self._pending_updates += (
                len(moments) * self._shape[0] * self._hyperparameters.updates_per_step
            )
        while self._pending_updates >= self._hyperparameters.policy_delay:
            self._pending_updates -= self._hyperparameters.policy_delay
            averager.add(self._learn())
        return averager.pop_means() | schedules

    def state_dict(self) -> dict[str, Any]:
        """See `Algorithm.state_dict`."""
        remembered = self._hyperparameters.save_replay_buffer
        return {
            "actor_optimizer": self._actor_optimizer.state_dict(),
            "critic_optimizer": self._critic_optimizer.state_dict(),
            "generator": self._generator.get_state(),
            "noise": self._noise.state,
            "due": self._pending_updates,
            "replay_buffer": self._buffer.state_dict() if remembered else None,
        }

    def load_state_dict(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """See `Algorithm.load_state_dict`."""
        if state["replay_buffer"] is not None:
            self._buffer.load_state_dict(state["replay_buffer"])
        self.policy.load_state_dict(weights)
        self._actor_optimizer.load_state_dict(state["actor_optimizer"])
        self._critic_optimizer.load_state_dict(state["critic_optimizer"])
        self._generator.set_state(state["generator"])
        self._noise.state = state["noise"].to(self._device)
        self._pending_updates = state["due"]

    # -- collecting ------------------------------------------------------------------------------

    def _play(self) -> _Moment:
        """Acts once in every environment."""
        env_runner, space = self._env_runner, self._env_runner.env.single_action_space
        before = env_runner.observations
        with timed("act"):
            actions = self._explore(before)
        step = env_runner.step(to_environment(self.policy.to_space(actions), space))
        self._new = np.flatnonzero(~step.same_frame)
        ended = torch.from_numpy(step.done)
        self._noise.restart(ended.to(self._device))
        return _Moment(before, actions.cpu().numpy(), step, env_runner.observations)

    def _explore(self, raw: Mapping[str, NDArray[Any]]) -> Tensor:
        """Actions (N, A) in [-1, 1]."""
        step, hyper = self._env_runner.step_count, self._hyperparameters
        uniform = 2.0 * self._rand(self._shape) - 1.0
        if step < hyper.buffer_init_steps:
            return uniform
        space = self._env_runner.env.single_observation_space
        observations = to_tensors(raw, space, self._device)
        actions = self.policy.online.act(observations, self._look(observations.frames))
        sigma = self._sigma(step / self._settings.max_steps)
        noisy = (actions + sigma * self._noise.sample(self._generator)).clamp(-1.0, 1.0)
        return torch.where(self._rand((len(noisy), 1)) < hyper.random_actions, uniform, noisy)

    def _look(self, frames: dict[str, Tensor]) -> Tensor | None:
        """What the actor makes of the frames in view, (N, f): each is encoded once."""
        online = self.policy.online
        if self._features is None:
            self._features = online.encode_frames(frames)
        elif len(self._new):
            rows = torch.from_numpy(self._new).to(self._device)
            fresh = online.encode_frames({name: gather(f, rows) for name, f in frames.items()})
            self._features = with_rows(self._features, rows, fresh)
        return self._features

    def _rand(self, shape: tuple[int, int]) -> Tensor:
        return torch.rand(shape, generator=self._generator, device=self._device)

    def _sigma(self, progress: float) -> float:
        noise = self._hyperparameters.noise
        return noise.schedule.value(noise.sigma, progress)

    # -- learning --------------------------------------------------------------------------------

    def _set_schedules(self, progress: float) -> dict[str, float]:
        hyper = self._hyperparameters
        rate = hyper.learning_rate_schedule.value(hyper.learning_rate, progress)
        critic_rate = hyper.learning_rate_schedule.value(
            hyper.critic_learning_rate or hyper.learning_rate, progress
        )
        self._actor_optimizer.param_groups[0]["lr"] = rate
        self._critic_optimizer.param_groups[0]["lr"] = critic_rate
        return {
            "Policy/Learning Rate": rate,
            "Policy/Critic Learning Rate": critic_rate,
            "Policy/Noise": self._sigma(progress),
        }

    def _remember(self, moments: list[_Moment]) -> None:
        """Adds what was collected to the buffer and to the statistics of the observations."""
        for moment in moments:
            self._buffer.add(moment.observations, moment.actions, moment.step, moment.following)
        space = self._env_runner.env.single_observation_space
        vectors = [to_tensors(m.observations, space, self._device).vectors for m in moments]
        self.policy.update_statistics({k: torch.cat([v[k] for v in vectors]) for k in vectors[0]})

    def _learn(self) -> dict[str, float]:
        """One round of updates (Lillicrap et al. 2015, algorithm 1)."""
        for _ in range(self._hyperparameters.policy_delay):
            indices = self._buffer.sample(self._hyperparameters.batch_size, self._generator)
            value_loss, value = self._improve_critic(indices)
        policy_loss = self._improve_actor(indices)
        self.policy.update_targets()
        numbers = torch.stack([value_loss, policy_loss, value]).tolist()
        names = ("Losses/Value Loss", "Losses/Policy Loss", "Policy/Q Value")
        return dict(zip(names, numbers, strict=True))

    def _improve_critic(self, indices: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """Descends the mean of (Q(s, a) - y)^2; returns it, and the mean of Q(s, a)."""
        online = self.policy.online
        targets = self._targets(indices)
        observations = self._augment(self._buffer.observations(indices, online.critic_sees))
        values = online.value(observations, self._buffer.actions(indices))
        loss = F.mse_loss(values, targets)
        self._optimizer_step(self._critic_optimizer, loss, self._critic_parameters)
        return loss.detach(), values.detach().mean()

    def _improve_actor(self, indices: NDArray[np.int64]) -> Tensor:
        """Descends the mean of -Q(s, mu(s)); returns it."""
        online = self.policy.online
        observations = self._augment(self._buffer.observations(indices, self._seen))
        loss = -online.value(observations, online.act(observations)).mean()
        self._optimizer_step(self._actor_optimizer, loss, self._actor_parameters)
        return loss.detach()

    @torch.no_grad()
    def _bootstrapped_returns(self, indices: NDArray[np.int64]) -> Tensor:
        """Targets y = R + gamma^k Q'(s', mu'(s')), (B,); R is the return of k steps up to s'."""
        hyper, target = self._hyperparameters, self.policy.target
        returns, discounts, last = self._buffer.returns(indices, hyper.gamma, hyper.n_step)
        following = self._augment(self._buffer.next_observations(last, self._seen))
        return returns + discounts * target.value(following, target.act(following))

    def _optimizer_step(
        self, optimizer: torch.optim.Optimizer, loss: Tensor, parameters: list[nn.Parameter]
    ) -> None:
        optimizer_step(
            optimizer, loss, parameters, self._max_gradient_norm, self._env_runner.step_count
        )
