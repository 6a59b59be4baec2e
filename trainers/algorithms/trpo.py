"""Trust Region Policy Optimization (Schulman et al. 2015, arXiv:1502.05477).

An update maximises the surrogate gain under a constraint (eq. 14, with advantages for Q):

    max_theta  E[pi_theta(a|s) / pi_old(a|s) A(s, a)]
    subject to E[KL(pi_old || pi_theta)] <= delta

in the paper's three steps: the gradient g of the gain; the step that solves the problem with its
gain made linear and its constraint quadratic (appendix C); a line search for what is left of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from pydantic import Field, field_validator
from torch import Tensor, nn
from torch.nn import functional as F

from trainers.algorithms.base import TrainerSettings
from trainers.algorithms.conjugate_gradient import conjugate_gradient
from trainers.algorithms.on_policy import OnPolicyAlgorithm, OnPolicyHyperparameters
from trainers.algorithms.optimization import (
    Mean,
    check_finite,
    set_learning_rates,
    unchanged,
)
from trainers.algorithms.schedules import CONSTANT, Schedule
from trainers.common.averager import Averager
from trainers.experience.env_runner import EnvRunner
from trainers.experience.rollout import Rollout
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.distributions import Distribution
from trainers.networks.factory import NetworkFactory

Product = Callable[[Tensor], Tensor]
"""A matrix, as what it makes of a vector."""


class TRPOHyperparameters(OnPolicyHyperparameters, frozen=True, extra="forbid"):
    """Hyper-parameters of TRPO; those of gradient descent are the critic's."""

    batch_size: int = Field(128, ge=1, description="Transitions in one step of the critic.")
    num_epoch: int = Field(10, ge=1, le=1000, description="The critic's passes over the buffer.")
    learning_rate: float = Field(
        1e-3, gt=0.0, description="Of the critic, to begin with; the policy's step is delta's."
    )
    delta: float = Field(0.01, gt=0.0, description="Most mean KL(old || new) of an update.")
    delta_schedule: Schedule = Field(CONSTANT, description="Course of delta.")
    damping: float = Field(0.1, ge=0.0, description="Added to the Fisher matrix's diagonal.")
    fisher_fraction: float = Field(
        1.0, gt=0.0, le=1.0, description="Share of the buffer that the Fisher matrix is taken over."
    )
    cg_iterations: int = Field(
        15, ge=1, le=1000, description="Most iterations of conjugate gradients."
    )
    cg_tolerance: float = Field(
        1e-5, ge=0.0, description="Residual that ends them sooner, relative to the gradient's norm."
    )
    backtrack_iterations: int = Field(
        10, ge=1, le=1000, description="Most trials of the line search."
    )
    backtrack_coefficient: float = Field(
        0.8, gt=0.0, lt=1.0, description="Each trial's share of the step tried before it."
    )


class TRPOPolicySettings(PolicySettings, frozen=True, extra="forbid"):
    """Networks of the actor and the critic, which share nothing."""

    critic: Literal["shared", "separate"] = Field(
        "separate", description="Only a critic with its own network suits TRPO."
    )

    @field_validator("critic")
    @classmethod
    def _leaves_the_policy_alone(cls, critic: str) -> str:
        if critic == "shared":
            raise ValueError(
                "'shared' does not suit trpo: what fits the critic would move the policy out of "
                "its trust region; use separate"
            )
        return critic


class TRPOSettings(TrainerSettings, frozen=True, extra="forbid"):
    """The `trainer` section of a run with TRPO."""

    hyperparameters: TRPOHyperparameters = Field(
        default_factory=TRPOHyperparameters, description="Hyper-parameters of TRPO."
    )
    network_settings: TRPOPolicySettings = Field(
        default_factory=TRPOPolicySettings, description="Networks of the actor and the critic."
    )


class TRPO(OnPolicyAlgorithm):
    """TRPO with a critic fitted by gradient descent. See `trainers.algorithms.base.Algorithm`."""

    Settings = TRPOSettings
    tags: ClassVar[Mapping[str, str]] = {
        "Losses/Policy Loss": "Surrogate gain of the step that was taken, negated; 0 for none.",
        "Losses/Value Loss": "Mean squared error of the critic's values as they are fitted.",
        "Policy/Entropy": "Mean entropy of the distribution of actions before the step, in nats.",
        "Policy/KL": "Mean KL(old || new) of the step that was taken, in nats; 0 for none.",
        "Policy/Line Search Steps": "Trials of the line search.",
        "Policy/Step Accepted": "1 where one of them was accepted; on average the share of updates "
        "that moved the policy.",
        "Policy/Explained Variance": "Share of the returns' variance that the values before the "
        "update explain: 1 is all, under 0 is worse than their mean.",
        "Policy/Learning Rate": "Of the critic, as scheduled.",
        "Policy/Delta": "Largest KL of a step, as scheduled.",
    }

    def __init__(
        self,
        factory: NetworkFactory,
        settings: TRPOSettings,
        env_runner: EnvRunner,
        generator: torch.Generator,
        device: torch.device,
    ):
        self._hyperparameters = settings.hyperparameters
        policy = self.build_policy(factory, settings).to(device)
        groups = (policy.critic_parameters(),)
        super().__init__(policy, groups, settings.hyperparameters, env_runner, generator, device)
        self._theta = [p for p in policy.actor_parameters() if p.requires_grad]

    @staticmethod
    def build_policy(factory: NetworkFactory, settings: TRPOSettings) -> ActorCritic:
        """See `Algorithm.build_policy`."""
        return ActorCritic(factory, settings.network_settings)

    def update(self, run_fraction: float) -> Mapping[str, float]:
        """See `Algorithm.update`."""
        rollout, hyper = self._pop_rollout(), self._hyperparameters
        delta = hyper.delta_schedule.value(hyper.delta, run_fraction)
        rate = hyper.learning_rate_schedule.value(hyper.learning_rate, run_fraction)
        set_learning_rates(self._optimizer, [rate])
        statistics = self._improve_policy(rollout, delta)
        statistics |= self._fit_critic(rollout)
        self._show(rollout)
        return statistics | {
            "Policy/Learning Rate": rate,
            "Policy/Delta": delta,
            "Policy/Explained Variance": self._explained_variance(rollout),
        }

    def _improve_policy(self, rollout: Rollout, delta: float) -> dict[str, float]:
        hyper = self._hyperparameters
        rows, weight = rollout.in_shuffle_groups()
        observations = rollout.observations(rows)
        actions, log_probs = rollout.actions[rows], rollout.log_probs[rows]
        advantages = self._normalized(rollout)[rows]
        mean = partial(self._env_runner.mean, weight=weight)

        def gain_of(distribution: Distribution) -> Tensor:
            return surrogate_gain(distribution, actions, log_probs, advantages)

        distribution = self.policy.distribution(observations)
        gain, old = gain_of(distribution), distribution.detach()
        gain, gradient = mean([gain, flat_gradient(gain, self._theta)])
        check_finite((-gain.item(), gradient.norm().item()), self._env_runner.step_count)

        def measure() -> tuple[Tensor, Tensor]:
            new = self.policy.distribution(observations)
            gain, divergence = mean([gain_of(new), old.kl(new).mean()])
            return gain, divergence

        step = self._step(rollout, gradient, delta)
        search = line_search(
            measure,
            self._theta,
            step,
            old_gain=gain.item(),
            delta=delta,
            coefficient=hyper.backtrack_coefficient,
            iterations=hyper.backtrack_iterations,
        )
        return {
            "Losses/Policy Loss": -search.gain,
            "Policy/Entropy": mean([old.entropy().mean()])[0].item(),
            "Policy/KL": search.divergence,
            "Policy/Line Search Steps": float(search.trials),
            "Policy/Step Accepted": float(search.accepted),
        }

    def _step(self, rollout: Rollout, gradient: Tensor, delta: float) -> Tensor:
        """The step of a gradient, with the Fisher matrix over a part of the rollout."""
        hyper = self._hyperparameters
        size = max(1, round(hyper.fisher_fraction * len(rollout.all_groups)))
        rows, weight = next(rollout.minibatches(size, self._generator))
        mean = partial(self._env_runner.mean, weight=weight)
        with _differentiable_twice(self.policy):
            distribution = self.policy.distribution(rollout.observations(rows))
            fisher = fisher_product(distribution, self._theta, hyper.damping, mean)
        return kl_constrained_step(
            gradient,
            fisher,
            delta,
            iterations=hyper.cg_iterations,
            tolerance=hyper.cg_tolerance,
        )

    def _fit_critic(self, rollout: Rollout) -> dict[str, float]:
        hyper = self._hyperparameters
        averager = Averager()
        for _ in range(hyper.num_epoch):
            for batch in rollout.minibatches(hyper.batch_size, self._generator):
                rows = batch.rows
                values = self.policy.value(rollout.observations(rows))
                loss = F.mse_loss(values, rollout.returns[rows])
                step = self._optimizer_step(loss, batch.weight).tolist()
                check_finite(step, self._env_runner.step_count)
                averager.add({"Losses/Value Loss": step[0]}, batch.own_count)
        return self._env_runner.means(averager)


def surrogate_gain(
    distribution: Distribution, actions: Tensor, old_log_probs: Tensor, advantages: Tensor
) -> Tensor:
    """Gain that the policy promises over the old one (Schulman et al. 2015, eq. 14), by samples.

    Args:
        distribution: the policy at B observations.
        actions: (B, ...) drawn by the old policy.
        old_log_probs: (B,) under the old policy.
        advantages: (B,) of the actions.
    """
    # L = E[pi_theta(a|s) / pi_old(a|s) A]
    ratio = (distribution.log_prob(actions) - old_log_probs).exp()
    return (ratio * advantages).mean()


def flat_gradient(
    value: Tensor, parameters: Sequence[nn.Parameter], *, differentiable: bool = False
) -> Tensor:
    """The gradient (n,) of a number by all n entries of the parameters, in their order."""
    return _flat(
        torch.autograd.grad(value, parameters, create_graph=differentiable, materialize_grads=True)
    )


def fisher_product(
    distribution: Distribution,
    parameters: Sequence[nn.Parameter],
    damping: float,
    mean: Mean = unchanged,
) -> Product:
    """The damped Fisher matrix of a policy, as its product with a vector (n,).

    Args:
        distribution: the policy at B observations, whose mean the Fisher matrix is; with the graph
            that leads to its parameters.
        parameters: the policy's, of n entries in all.
        damping: added to the diagonal.
        mean: of products over all processes of a run.
    """
    # H = d^2/dtheta^2 E[KL(pi_old || pi_theta)] at theta = theta_old (appendix C.1): the actions'
    # expectation is exact, only the states are samples. Its gradient there is zero, its graph not.
    divergence = distribution.detach().kl(distribution).mean()
    gradient = flat_gradient(divergence, parameters, differentiable=True)

    def product(vector: Tensor) -> Tensor:
        # H v = d/dtheta (gradient^T v)
        parts = torch.autograd.grad(
            gradient, parameters, vector, retain_graph=True, materialize_grads=True
        )
        (whole,) = mean([_flat(parts)])
        return whole + damping * vector

    return product


def kl_constrained_step(
    gradient: Tensor, fisher: Product, delta: float, *, iterations: int, tolerance: float
) -> Tensor:
    """The step s of greatest gain g^T s with s^T H s / 2 <= delta (appendix C).

    Args:
        gradient: g, (n,).
        fisher: v -> H v.
        delta: the most divergence, to second order.
        iterations: of conjugate gradients, at most.
        tolerance: see `conjugate_gradient`.

    Returns:
        s, (n,); 0 where there is no gradient to follow.
    """
    # H x = g,    s = sqrt(2 delta / x^T H x) x
    direction = conjugate_gradient(fisher, gradient, iterations, tolerance)
    curvature = direction.dot(fisher(direction))
    if curvature == 0:
        return torch.zeros_like(gradient)
    return (2 * delta / curvature).sqrt() * direction


@dataclass(frozen=True)
class LineSearch:
    """Result of a line search.

    Attributes:
        gain: of the policy that the search ended with.
        divergence: its mean KL(old || new).
        trials: steps that were tried.
        accepted: whether one was taken; if not, the policy is the old one.
    """

    gain: float
    divergence: float
    trials: int
    accepted: bool


@torch.no_grad()
def line_search(
    measure: Callable[[], tuple[Tensor, Tensor]],
    parameters: Sequence[nn.Parameter],
    step: Tensor,
    *,
    old_gain: float,
    delta: float,
    coefficient: float,
    iterations: int,
) -> LineSearch:
    """Take the first of step, coefficient step, coefficient^2 step, ... that keeps the promise.

    That is one with more gain than the old policy's and no more divergence than delta. Where none
    does, because it is not even finite for instance, the parameters are put back exactly.

    Args:
        measure: says the gain and the mean KL(old || new) of the policy as it is now.
        parameters: the policy's, at the old policy; moved in place.
        step: (n,) the whole step.
        old_gain: the gain of the old policy.
        delta: the most divergence.
        coefficient: each trial's share of the one before.
        iterations: trials, at most.
    """
    old = _flat(parameters)
    for trial in range(iterations):
        _assign(parameters, old + coefficient**trial * step)
        gain, divergence = (value.item() for value in measure())
        if gain > old_gain and divergence <= delta:
            return LineSearch(gain, divergence, trial + 1, accepted=True)
    _assign(parameters, old)
    return LineSearch(old_gain, 0.0, iterations, accepted=False)


def _differentiable_twice(policy: ActorCritic) -> AbstractContextManager[None]:
    """Context where gradients of the policy have gradients: cuDNN's recurrent layers have none."""
    return torch.backends.cudnn.flags(enabled=False) if policy.state_size else nullcontext()


def _flat(tensors: Iterable[Tensor]) -> Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def _assign(parameters: Sequence[nn.Parameter], vector: Tensor) -> None:
    # In place: torch's `vector_to_parameters` would make them views of the vector.
    parts = vector.split([parameter.numel() for parameter in parameters])
    for parameter, part in zip(parameters, parts, strict=True):
        parameter.copy_(part.view_as(parameter))
