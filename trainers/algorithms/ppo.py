"""Proximal Policy Optimization (Schulman et al. 2017, arXiv:1707.06347)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain

import torch
from pydantic import Field
from torch import Tensor, nn

from trainers.algorithms.base import TrainerSettings
from trainers.algorithms.on_policy import OnPolicyAlgorithm, OnPolicyHyperparameters
from trainers.algorithms.schedules import CONSTANT, LINEAR, Schedule
from trainers.common.averager import Averager
from trainers.experience.env_runner import EnvRunner
from trainers.experience.returns import explained_variance, normalize
from trainers.experience.rollout import Rollout
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.distributions import Distribution
from trainers.networks.factory import NetworkFactory


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


class PPO(OnPolicyAlgorithm):
    """PPO with a clipped objective. See `trainers.algorithms.base.Algorithm`."""

    Settings = PPOSettings

    def __init__(
        self,
        factory: NetworkFactory,
        settings: PPOSettings,
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        self._hyperparameters = settings.hyperparameters
        policy = ActorCritic(factory, settings.network_settings).to(device)
        actor, critic = policy.actor_parameters(), policy.critic_parameters()
        # A step of the optimiser costs by the group: one where actor and critic share their rate.
        groups: tuple[Iterable[nn.Parameter], ...] = (chain(actor, critic),)
        if settings.hyperparameters.critic_learning_rate is not None:
            groups = (actor, critic)
        super().__init__(policy, groups, settings.hyperparameters, env_runner, generator, device)

    def update(self, progress: float) -> Mapping[str, float]:
        """See `Algorithm.update`."""
        rollout = self._pop_rollout()
        schedules = self._set_schedules(progress)
        advantages = normalize(rollout.advantages)
        averager = Averager()
        for _ in range(self._hyperparameters.num_epoch):
            if not self._epoch(rollout, advantages, schedules, averager):
                break
        self.policy.update_statistics(rollout.vectors)
        statistics = averager.pop_means()
        variance = explained_variance(rollout.returns, rollout.values)
        return statistics | schedules | {"Policy/Explained Variance": variance}

    def _set_schedules(self, progress: float) -> dict[str, float]:
        hyper = self._hyperparameters
        rate = hyper.learning_rate_schedule.value(hyper.learning_rate, progress)
        critic_rate = hyper.learning_rate_schedule.value(
            hyper.critic_learning_rate or hyper.learning_rate, progress
        )
        for group, value in zip(self._optimizer.param_groups, (rate, critic_rate), strict=False):
            group["lr"] = value
        return {
            "Policy/Learning Rate": rate,
            "Policy/Critic Learning Rate": critic_rate,
            "Policy/Epsilon": hyper.epsilon_schedule.value(hyper.epsilon, progress),
            "Policy/Beta": hyper.beta_schedule.value(hyper.beta, progress),
        }

    def _epoch(
        self,
        rollout: Rollout,
        advantages: Tensor,
        schedules: dict[str, float],
        averager: Averager,
    ) -> bool:
        """One pass over the rollout; False once the policy has moved far enough."""
        hyper = self._hyperparameters
        for rows in rollout.minibatches(hyper.batch_size, self._generator):
            distribution, values = self.policy(rollout.observations(rows))
            policy_loss, statistics = surrogate_loss(
                distribution,
                rollout.actions[rows],
                rollout.log_probs[rows],
                advantages[rows],
                schedules["Policy/Epsilon"],
            )
            value_loss = clipped_value_loss(
                values, rollout.values[rows], rollout.returns[rows], hyper.value_clipping
            )
            entropy = distribution.entropy().mean()
            # L = L_clip + c_v L_value - beta H + c_kl KL
            loss = policy_loss + hyper.value_coefficient * value_loss
            for weight, term in (
                (-schedules["Policy/Beta"], entropy),
                (hyper.kl_penalty, statistics["Policy/KL"]),
            ):
                if weight:  # the gradient of what weighs nothing costs as much as any
                    loss = loss + weight * term
            self._optimizer_step(loss)
            statistics |= {
                "Losses/Policy Loss": policy_loss,
                "Losses/Value Loss": value_loss,
                "Policy/Entropy": entropy,
            }
            # All at once: on an accelerator each look at a number waits for all that is under way.
            numbers = torch.stack(list(statistics.values())).tolist()
            means = dict(zip(statistics, numbers, strict=True))
            averager.add(means, len(rows))
            if hyper.target_kl is not None and means["Policy/KL"] > hyper.target_kl:
                return False
        return True


def surrogate_loss(
    distribution: Distribution,
    actions: Tensor,
    old_log_probs: Tensor,
    advantages: Tensor,
    epsilon: float,
) -> tuple[Tensor, dict[str, Tensor]]:
    """PPO's clipped objective, negated (Schulman et al. 2017, eq. 7), with its diagnostics.

    Args:
        distribution: the present policy at B observations.
        actions: (B, ...) drawn by the old policy.
        old_log_probs: (B,) under the old policy.
        advantages: (B,).
        epsilon: how far the ratio may move from 1.
    """
    log_ratio = distribution.log_prob(actions) - old_log_probs
    ratio = log_ratio.exp()
    # L = E[min(r A, clip(r, 1 - eps, 1 + eps) A)]
    clipped = ratio.clamp(1.0 - epsilon, 1.0 + epsilon)
    loss = -torch.min(ratio * advantages, clipped * advantages).mean()
    # KL(old || new) = E_old[(r - 1) - log r]: never negative, and of low variance.
    divergence = ((ratio - 1.0) - log_ratio).mean()
    clip_fraction = ((ratio.detach() - 1.0).abs() > epsilon).float().mean()
    return loss, {"Policy/KL": divergence, "Policy/Clip Fraction": clip_fraction}


def clipped_value_loss(
    values: Tensor, old_values: Tensor, returns: Tensor, clipping: float | None
) -> Tensor:
    """Mean squared error of values (B,); with `clipping` the worse of the free and the clipped."""
    loss = (values - returns).square()
    if clipping is not None:
        held = old_values + (values - old_values).clamp(-clipping, clipping)
        loss = torch.max(loss, (held - returns).square())
    return loss.mean()
