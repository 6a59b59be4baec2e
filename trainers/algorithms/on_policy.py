"""Common parts of algorithms that learn from the present policy's own experience, as PPO does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from gymnasium.spaces import Box
from pydantic import BaseModel, Field, model_validator
from torch import Tensor, nn

from trainers.algorithms.optimization import (
    adam,
    load_generator,
    load_optimizer,
    optimizer_state,
    optimizer_step,
)
from trainers.algorithms.schedules import LINEAR, Schedule
from trainers.common.errors import UserError
from trainers.experience.env_runner import EnvRunner
from trainers.experience.memory import check_room
from trainers.experience.returns import explained_variance, normalize
from trainers.experience.reward_normalizer import RewardNormalizer
from trainers.experience.rollout import Rollout
from trainers.experience.rollout_collector import RolloutCollector
from trainers.networks.actor_critic import ActorCritic


class OnPolicyHyperparameters(BaseModel, frozen=True, extra="forbid"):
    """Hyper-parameters of collecting, estimating advantages and optimizer steps."""

    batch_size: int = Field(512, ge=1, description="Transitions in one step of gradient descent.")
    buffer_size: int = Field(8192, ge=1, description="Transitions collected before an update.")
    num_epoch: int = Field(3, ge=1, le=1000, description="Passes over the buffer in an update.")
    learning_rate_schedule: Schedule = Field(LINEAR, description="Course of the learning rates.")
    gamma: float = Field(0.99, ge=0.0, le=1.0, description="Discount factor.")
    lambd: float = Field(0.95, ge=0.0, le=1.0, description="Lambda of the advantage estimate.")
    baseline: Literal["critic", "frame"] = Field(
        "critic",
        description="What an action's return is compared with: the critic's value, or the mean "
        "return of the other actions tried at the same frame, which needs gamma: 0.",
    )
    antithetic: bool = Field(
        False,
        description="Continuous actions: every second step mirrors the noise of the one before.",
    )
    normalize_rewards: bool = Field(
        False, description="Scale rewards by the standard deviation of the discounted returns."
    )
    max_gradient_norm: float = Field(0.5, gt=0.0, description="Gradients are clipped to this norm.")

    @model_validator(mode="after")
    def _batch_fits(self) -> OnPolicyHyperparameters:
        if self.batch_size > self.buffer_size:
            raise ValueError(
                f"batch_size {self.batch_size} is over buffer_size {self.buffer_size}: lower "
                "batch_size, or raise buffer_size"
            )
        return self

    @model_validator(mode="after")
    def _tries_are_independent(self) -> OnPolicyHyperparameters:
        if self.baseline == "frame" and self.gamma > 0.0:
            raise ValueError(
                f"baseline: frame needs gamma: 0, not {self.gamma:g}: with later rewards in it, "
                "the return of another try depends on this one's action"
            )
        return self


class OnPolicyAlgorithm:
    """Collects rollouts, takes optimizer steps and keeps the state; a subclass says how to update.

    Args:
        policy: the actor and the critic, on the device.
        groups: the parameters that gradient descent moves, one group per learning rate. The rates
            are the subclass's to set, in each update.
        hyperparameters: what all algorithms of this kind have.
        env_runner: the environments.
        generator: the source of all randomness.
        device: where the policy lives.

    Raises:
        UserError: mirrored noise was asked for, and actions are discrete.
    """

    state_axes: ClassVar[Mapping[str, Any]] = {
        "collector": {"remembered": 0, "reward_normalizer": {"carried": 0}}
    }

    def __init__(
        self,
        policy: ActorCritic,
        groups: Iterable[Iterable[nn.Parameter]],
        hyperparameters: OnPolicyHyperparameters,
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        self.policy = policy
        self._optimizer = adam(groups, device, eps=1e-5)
        self._gamma, self._lambd = hyperparameters.gamma, hyperparameters.lambd
        if hyperparameters.antithetic and not isinstance(env_runner.env.single_action_space, Box):
            raise UserError(
                "trainer.hyperparameters.antithetic: mirrored noise is of continuous actions, and "
                "the environment's are discrete: leave it out"
            )
        steps = -(-hyperparameters.buffer_size // env_runner.num_envs)
        self.collection_steps = steps * env_runner.num_envs
        pooled = 1 + env_runner.world.shares_memory
        check_room(env_runner.env, pooled * steps, "trainer.hyperparameters.buffer_size")
        reward_normalizer = (
            RewardNormalizer(env_runner.env.num_envs, self._gamma)
            if hyperparameters.normalize_rewards
            else None
        )
        self._collector = RolloutCollector(
            policy,
            env_runner,
            steps,
            generator,
            device,
            reward_normalizer,
            antithetic=hyperparameters.antithetic,
        )
        self._compares_tries = hyperparameters.baseline == "frame"
        self._max_gradient_norm = hyperparameters.max_gradient_norm
        self._env_runner, self._generator = env_runner, generator
        self._rollout: Rollout | None = None

    def collect(self) -> None:
        """See `Algorithm.collect`."""
        rollout = self._collector.collect(self._gamma, self._lambd)
        if self._compares_tries:
            rollout = rollout.against_other_tries(self._env_runner.world)
        self._rollout = rollout.pooled(self._env_runner.world)

    def state_dict(self) -> dict[str, Any]:
        """See `Algorithm.state_dict`."""
        return {
            "optimizer": optimizer_state(self._optimizer),
            "collector": self._collector.state_dict(),
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """See `Algorithm.load_state_dict`."""
        self.policy.load_state_dict(weights)
        load_optimizer(self._optimizer, state["optimizer"])
        self._collector.load_state_dict(state["collector"])
        load_generator(self._generator, state["generator"])

    def _pop_rollout(self) -> Rollout:
        """The experience of the last collection, for one update alone."""
        rollout, self._rollout = self._rollout, None
        if rollout is None:
            raise RuntimeError("update() comes after collect()")
        return rollout

    def _show(self, rollout: Rollout) -> None:
        """Shows all processes' vector observations to the encoders that standardise."""
        vectors = {name: self._all_rows(rollout, own) for name, own in rollout.vectors.items()}
        self.policy.update_statistics(vectors)

    def _explained_variance(self, rollout: Rollout) -> float:
        """Of all processes' returns."""
        returns, values = (self._all_rows(rollout, x) for x in (rollout.returns, rollout.values))
        return explained_variance(returns, values)

    def _normalized(self, rollout: Rollout) -> Tensor:
        """Advantages, by the mean and the deviation of those of all processes."""
        return normalize(rollout.advantages, self._all_rows(rollout, rollout.advantages))

    def _all_rows(self, rollout: Rollout, rows: Tensor) -> Tensor:
        """Everyone's (T N, ...), by step, then by environment, of a field of a rollout."""
        if rollout.places is not None:
            return rows[rollout.places]
        return self._env_runner.all_rows(rows)

    def _optimizer_step(self, loss: Tensor, weight: float) -> Tensor:
        """One step of gradient descent, if all is finite; see `optimizer_step`.

        Args:
            loss: of one's own transitions.
            weight: see `Minibatch`.

        Raises:
            StopRequested: the run is to stop; nothing was changed.
        """
        parameters = [p for group in self._optimizer.param_groups for p in group["params"]]
        mean = partial(self._env_runner.mean, weight=weight)
        return optimizer_step(
            self._optimizer,
            loss,
            parameters,
            self._max_gradient_norm,
            mean,
            alone=self._env_runner.world.size == 1,
        )
