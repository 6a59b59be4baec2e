"""What a policy's last layer says of actions: one model for each kind of action space."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Literal

import gymnasium
import torch
from pydantic import BaseModel, Field, model_validator
from torch import Tensor, nn

from trainers.common.errors import UserError
from trainers.networks.actions import ActionScaling
from trainers.networks.distributions import (
    Categorical,
    DiagonalGaussian,
    Distribution,
    MultiCategorical,
    TanhGaussian,
)

NO_LOG_STD = -1000.0  # exp of it is 0
NETWORK_PATH = "trainer.network_settings"


class GaussianSettings(BaseModel, frozen=True, extra="forbid"):
    """The Gaussian that continuous actions are drawn from; 1 is half the distance of the bounds."""

    initial_std: float = Field(
        1.0,
        gt=0.0,
        description="Continuous actions: standard deviation to begin with; 1 is half the distance "
        "of an action's bounds, or one of its own units where it lacks a bound.",
    )
    min_std: float = Field(
        0.001,
        gt=0.0,
        description="Continuous actions: the standard deviation never falls below; equal to "
        "initial_std, it stays there and is not learned.",
    )
    state_dependent_std: bool = Field(
        False,
        description="Continuous actions: the network says the standard deviation for each "
        "observation; otherwise one is learned for all.",
    )
    squash: Literal["tanh"] | None = Field(
        None,
        description="Continuous actions: what keeps them within their bounds, the tanh of what is "
        "drawn; null: they are cut off there.",
    )

    @model_validator(mode="after")
    def _std_can_move(self) -> GaussianSettings:
        if self.min_std > self.initial_std:
            raise ValueError(
                f"min_std {self.min_std:g} is over initial_std {self.initial_std:g}: lower it"
            )
        if self.state_dependent_std and self.min_std == self.initial_std:
            raise ValueError(
                "state_dependent_std learns the deviation, which min_std equal to initial_std "
                "keeps where it is: lower min_std, or leave state_dependent_std out"
            )
        return self


class ActionModel(nn.Module, ABC):
    """Distributions from what the last layer says, and actions from what is drawn of them.

    Attributes:
        outputs: numbers that the last layer says of each observation.
    """

    outputs: int

    @abstractmethod
    def forward(self, outputs: Tensor) -> Distribution:
        """The distribution of B actions, for (B, outputs)."""

    def actions(self, draws: Tensor) -> Tensor:
        """What is drawn, (B, ...), in the units of the environment's space, out of bounds or not.

        Of discrete actions, that is the number of each choice, from 0.
        """
        return draws

    def exploration_std(self) -> Tensor | None:
        """See `PolicyNetwork.exploration_std`."""
        return None


class GaussianActions(ActionModel):
    """Continuous actions: of a Gaussian in a space where the bounds are -1 and 1.

    Args:
        space: of the environment's actions.
        settings: of the Gaussian.

    Attributes:
        scale: from that space to the environment's.
        log_std: (A,) what is learned of the deviation; None where the network says it.

    Raises:
        UserError: actions without bounds are to be squashed.
    """

    _min_log_std: Tensor

    def __init__(self, space: gymnasium.spaces.Box, settings: GaussianSettings):
        super().__init__()
        self._distribution = DiagonalGaussian if settings.squash is None else TanhGaussian
        self._squash = nn.Identity() if settings.squash is None else nn.Tanh()
        # With the weights, because those of before had their Gaussian in the environment's units.
        self.scale = ActionScaling(space, unbounded=True, saved=True)
        if settings.squash is not None and not self.scale.is_bounded:
            raise UserError(
                f"{NETWORK_PATH}.squash: tanh needs bounds to stay within, and this environment's "
                f"actions, {space}, lack some: leave it out"
            )
        above = settings.initial_std - settings.min_std
        self._initial = math.log(above) if above else NO_LOG_STD
        self.log_std: nn.Parameter | None = None
        self.outputs = 2 * self.scale.size
        if not settings.state_dependent_std:
            self.outputs = self.scale.size
            initial = torch.full((self.scale.size,), self._initial)
            self.log_std = nn.Parameter(initial, requires_grad=above > 0)
        min_log_std = torch.tensor(math.log(settings.min_std))
        self.register_buffer("_min_log_std", min_log_std, persistent=False)

    def forward(self, outputs: Tensor) -> Distribution:
        """See `ActionModel`."""
        if self.log_std is not None:
            return self._distribution(outputs, self._log_std(self.log_std))
        mean, learned = outputs.chunk(2, dim=1)
        return self._distribution(mean, self._log_std(learned + self._initial))

    def actions(self, draws: Tensor) -> Tensor:
        """See `ActionModel`."""
        actions: Tensor = self.scale(self._squash(draws))
        return actions

    def exploration_std(self) -> Tensor | None:
        """See `PolicyNetwork.exploration_std`."""
        if self.log_std is None or self._distribution is TanhGaussian:
            return None
        return self._log_std(self.log_std).exp() * self.scale.half_range

    def _log_std(self, learned: Tensor) -> Tensor:
        """Logarithms of the standard deviations, of the same shape."""
        # std = min_std + exp(learned): a floor that, unlike a clamp, always lets gradients through.
        return torch.logaddexp(learned, self._min_log_std)


class CategoricalActions(ActionModel):
    """One of some discrete actions."""

    def __init__(self, count: int):
        super().__init__()
        self.outputs = count

    def forward(self, outputs: Tensor) -> Distribution:
        """See `ActionModel`."""
        return Categorical(outputs)


class MultiCategoricalActions(ActionModel):
    """Several choices at once, each between some discrete actions."""

    def __init__(self, sizes: tuple[int, ...]):
        super().__init__()
        self._sizes = sizes
        self.outputs = sum(sizes)

    def forward(self, outputs: Tensor) -> Distribution:
        """See `ActionModel`."""
        return MultiCategorical(outputs, self._sizes)


def action_model(space: gymnasium.Space[Any], settings: GaussianSettings) -> ActionModel:
    """The model of a space's actions.

    Raises:
        UserError: there is none, or the settings are of another.
    """
    match space:
        case gymnasium.spaces.Box(shape=(_,)):
            return GaussianActions(space, settings)
        case gymnasium.spaces.Discrete():
            model: ActionModel = CategoricalActions(int(space.n))
        case gymnasium.spaces.MultiDiscrete(shape=(_,)):
            model = MultiCategoricalActions(tuple(space.nvec.tolist()))
        case gymnasium.spaces.MultiBinary(shape=(count,)):
            # A choice between two is a Bernoulli, whose logit is the difference of theirs.
            model = MultiCategoricalActions((2,) * count)
        case _:
            raise UserError(
                f"environment: actions of the space {space} are not supported; a Box, a "
                "MultiDiscrete or a MultiBinary of one dimension, and Discrete are"
            )
    for name in ("squash", "state_dependent_std"):
        if getattr(settings, name):
            raise UserError(
                f"{NETWORK_PATH}.{name}: is of continuous actions, and the environment's are "
                f"{space}: leave it out"
            )
    return model
