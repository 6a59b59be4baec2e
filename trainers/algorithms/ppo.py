"""Proximal Policy Optimization (Schulman et al. 2017, arXiv:1707.06347)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from trainers.algorithms.base import TrainerSettings
from trainers.algorithms.on_policy import OnPolicyAlgorithm, OnPolicyHyperparameters
from trainers.algorithms.optimization import check_finite, set_learning_rates
from trainers.algorithms.schedules import CONSTANT, LINEAR, Schedule
from trainers.common.averager import Averager
from trainers.experience.env_runner import EnvRunner
from trainers.experience.rollout import Rollout
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.distributions import Distribution
from trainers.networks.factory import NetworkFactory

MOST_CHANGE = 1.2
"""Of the learning rate from one update to the next, as a factor."""

KL = "Policy/KL"
STATISTICS = (
    KL,
    "Policy/Clip Fraction",
    "Losses/Policy Loss",
    "Losses/Value Loss",
    "Policy/Entropy",
)


class PPOHyperparameters(OnPolicyHyperparameters, frozen=True, extra="forbid"):
    """Hyper-parameters of PPO, with ML-Agents' names where the thing is the same."""

    learning_rate: float = Field(3e-4, gt=0.0, description="Of the policy, to begin with.")
    critic_learning_rate: float | None = Field(
        None, gt=0.0, description="Of the critic, to begin with; null: the policy's."
    )
    epsilon: float = Field(0.2, gt=0.0, description="How far the probability ratio may move.")
    epsilon_schedule: Schedule = Field(CONSTANT, description="Course of epsilon.")
    beta: float = Field(5e-3, ge=0.0, description="Weight of the entropy bonus.")
    beta_schedule: Schedule = Field(LINEAR, description="Course of beta.")
    kl_penalty: float = Field(0.0, ge=0.0, description="Weight of a penalty on KL(old || new).")
    target_kl: float | None = Field(
        None, gt=0.0, description="Ends an update once the mean KL(old || new) is over this."
    )
    desired_kl: float | None = Field(
        None,
        gt=0.0,
        description="The policy's learning rate is scaled from update to update so that the mean "
        "KL(old || new) of an update stays near this: the smaller the deviation of the actions, "
        "the smaller the steps that move it as far. null: the rate is as scheduled.",
    )
    desired_kl_schedule: Schedule = Field(CONSTANT, description="Course of desired_kl.")
    value_coefficient: float = Field(0.5, gt=0.0, description="Weight of the value loss.")
    value_clipping: float | None = Field(
        None, gt=0.0, description="How far a value may move in an update; null: anywhere."
    )


class PPOSettings(TrainerSettings, frozen=True, extra="forbid"):
    """The `trainer` section of a run with PPO."""

    hyperparameters: PPOHyperparameters = Field(
        default_factory=PPOHyperparameters, description="Hyper-parameters of PPO."
    )
    network_settings: PolicySettings = Field(
        default_factory=PolicySettings, description="Networks of the actor and the critic."
    )


@dataclass(frozen=True)
class _Scheduled:
    """Scheduled hyper-parameters, as they are in one update."""

    learning_rate: float
    critic_learning_rate: float
    epsilon: float
    beta: float


class PPO(OnPolicyAlgorithm):
    """PPO with a clipped objective. See `trainers.algorithms.base.Algorithm`."""

    Settings = PPOSettings
    tags: ClassVar[Mapping[str, str]] = {
        "Losses/Policy Loss": "Clipped objective, negated; without entropy bonus and KL penalty.",
        "Losses/Value Loss": "Mean squared error of the critic's values, before its coefficient.",
        "Policy/Entropy": "Mean entropy of the distribution of actions, in nats.",
        "Policy/KL": "Mean KL(old || new) in nats, by the ratio of probabilities: how far the "
        "policy has moved within an update.",
        "Policy/Clip Fraction": "Share of the actions whose ratio of probabilities is beyond "
        "epsilon.",
        "Policy/Explained Variance": "Share of the returns' variance that the values before the "
        "update explain: 1 is all, under 0 is worse than their mean.",
        "Policy/Learning Rate": "Of the policy, as scheduled and as desired_kl scales it.",
        "Policy/Critic Learning Rate": "Of the critic, as scheduled.",
        "Policy/Epsilon": "How far the ratio of probabilities may move, as scheduled.",
        "Policy/Beta": "Weight of the entropy bonus, as scheduled.",
    }

    def __init__(
        self,
        factory: NetworkFactory,
        settings: PPOSettings,
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        self._hyperparameters = settings.hyperparameters
        policy = self.build_policy(factory, settings).to(device)
        actor, critic = policy.actor_parameters(), policy.critic_parameters()
        # A step of the optimiser costs by the group: one where actor and critic share their rate.
        groups: tuple[Iterable[nn.Parameter], ...] = (chain(actor, critic),)
        if settings.hyperparameters.critic_learning_rate is not None:
            groups = (actor, critic)
        super().__init__(policy, groups, settings.hyperparameters, env_runner, generator, device)
        self._rate_scale = 1.0  # of the policy's learning rate

    @staticmethod
    def build_policy(factory: NetworkFactory, settings: PPOSettings) -> ActorCritic:
        """See `Algorithm.build_policy`."""
        return ActorCritic(factory, settings.network_settings)

    def state_dict(self) -> dict[str, Any]:
        """See `Algorithm.state_dict`."""
        return {**super().state_dict(), "rate_scale": self._rate_scale}

    def load_state_dict(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """See `Algorithm.load_state_dict`."""
        super().load_state_dict(weights, state)
        self._rate_scale = state.get("rate_scale", 1.0)  # not in those of former versions

    def update(self, run_fraction: float) -> Mapping[str, float]:
        """See `Algorithm.update`."""
        rollout = self._pop_rollout()
        scheduled = self._schedule(run_fraction)
        advantages = self._normalized(rollout)
        averager = Averager()
        for _ in range(self._hyperparameters.num_epoch):
            if not self._epoch(rollout, advantages, scheduled, averager):
                break
        self._show(rollout)
        means, hyper = self._env_runner.means(averager), self._hyperparameters
        if hyper.desired_kl is not None:
            desired = hyper.desired_kl_schedule.value(hyper.desired_kl, run_fraction)
            self._rate_scale *= rate_change(means[KL], desired)
        return means | {
            "Policy/Learning Rate": scheduled.learning_rate,
            "Policy/Critic Learning Rate": scheduled.critic_learning_rate,
            "Policy/Epsilon": scheduled.epsilon,
            "Policy/Beta": scheduled.beta,
            "Policy/Explained Variance": self._explained_variance(rollout),
        }

    def _schedule(self, run_fraction: float) -> _Scheduled:
        hyper = self._hyperparameters
        rates = hyper.learning_rate_schedule
        rate = self._rate_scale * rates.value(hyper.learning_rate, run_fraction)
        critic = hyper.critic_learning_rate
        scheduled = _Scheduled(
            learning_rate=rate,
            critic_learning_rate=rate if critic is None else rates.value(critic, run_fraction),
            epsilon=hyper.epsilon_schedule.value(hyper.epsilon, run_fraction),
            beta=hyper.beta_schedule.value(hyper.beta, run_fraction),
        )
        # One group where actor and critic share their rate.
        learning_rates = (scheduled.learning_rate, scheduled.critic_learning_rate)
        groups = len(self._optimizer.param_groups)
        set_learning_rates(self._optimizer, learning_rates[:groups])
        return scheduled

    def _epoch(
        self,
        rollout: Rollout,
        advantages: Tensor,
        scheduled: _Scheduled,
        averager: Averager,
    ) -> bool:
        """One pass over the rollout; False once the policy has moved far enough."""
        hyper = self._hyperparameters
        for batch in rollout.minibatches(hyper.batch_size, self._generator):
            rows = batch.rows
            distribution, values = self.policy(rollout.observations(rows))
            policy_loss, divergence, clip_fraction = surrogate_loss(
                distribution,
                rollout.actions[rows],
                rollout.log_probs[rows],
                advantages[rows],
                scheduled.epsilon,
            )
            value_loss = clipped_value_loss(
                values, rollout.values[rows], rollout.returns[rows], hyper.value_clipping
            )
            entropy = distribution.entropy().mean()
            # L = L_clip + c_v L_value - beta H + c_kl KL
            loss = policy_loss + hyper.value_coefficient * value_loss
            for weight, term in ((-scheduled.beta, entropy), (hyper.kl_penalty, divergence)):
                if weight:  # the gradient of what weighs nothing costs as much as any
                    loss = loss + weight * term
            step = self._optimizer_step(loss, batch.weight)
            statistics = torch.stack((divergence, clip_fraction, policy_loss, value_loss, entropy))
            if hyper.target_kl is not None:  # which all processes have to agree on
                (statistics,) = self._env_runner.mean([statistics], batch.weight)
            # All at once: on an accelerator each number read waits for all that is under way.
            *loss_and_norm, kl, _, _, _, _ = numbers = torch.cat((step, statistics)).tolist()
            check_finite(loss_and_norm, self._env_runner.step_count)
            means = numbers[len(loss_and_norm) :]
            averager.add(dict(zip(STATISTICS, means, strict=True)), batch.own_count)
            if hyper.target_kl is not None and kl > hyper.target_kl:
                return False
        return True


def rate_change(divergence: float, desired: float) -> float:
    """Factor of the learning rate after an update, which brings its KL near the desired one.

    The divergence grows with the square of the steps. It is at most 1.2 either way, so that
    the noise of one update's divergence moves little (Schulman et al. 2017, section 4, adapts the
    weight of a penalty alike).
    """
    wanted = math.sqrt(desired / max(divergence, desired / 100.0))
    return min(max(wanted, 1.0 / MOST_CHANGE), MOST_CHANGE)


def surrogate_loss(
    distribution: Distribution,
    actions: Tensor,
    old_log_probs: Tensor,
    advantages: Tensor,
    epsilon: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """PPO's clipped objective, negated (Schulman et al. 2017, eq. 7), with its diagnostics.

    Args:
        distribution: the present policy at B observations.
        actions: (B, ...) drawn by the old policy.
        old_log_probs: (B,) under the old policy.
        advantages: (B,).
        epsilon: how far the ratio may move from 1.

    Returns:
        The loss, the mean KL(old || new), and the share of ratios beyond epsilon.
    """
    log_ratio = distribution.log_prob(actions) - old_log_probs
    ratio = log_ratio.exp()
    # L = E[min(r A, clip(r, 1 - eps, 1 + eps) A)]
    clipped = ratio.clamp(1.0 - epsilon, 1.0 + epsilon)
    loss = -torch.min(ratio * advantages, clipped * advantages).mean()
    # KL(old || new) = E_old[(r - 1) - log r]: never negative, and of low variance.
    divergence = ((ratio - 1.0) - log_ratio).mean()
    clip_fraction = ((ratio.detach() - 1.0).abs() > epsilon).float().mean()
    return loss, divergence, clip_fraction


def clipped_value_loss(
    values: Tensor, old_values: Tensor, returns: Tensor, clipping: float | None
) -> Tensor:
    """Mean squared error of values (B,); with `clipping` the worse of the free and the clipped."""
    loss = (values - returns).square()
    if clipping is not None:
        held = old_values + (values - old_values).clamp(-clipping, clipping)
        loss = torch.max(loss, (held - returns).square())
    return loss.mean()
