"""Between a network's actions and an environment's."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from encoders.spaces import bounded
from trainers.common.errors import NonFiniteError, UserError


class ActionScaling(nn.Module):
    """Actions (B, A) of a network to those of a space: from -1 to 1 are its bounds.

    Args:
        space: of the environment's actions.
        unbounded: take spaces with dimensions that lack a bound, too: those stay as they are.
        saved: keep the scale with the weights.

    Attributes:
        size: A.
        is_bounded: whether all dimensions are scaled.
        middle: (A,) of the bounds.
        half_range: (A,) half their distance.

    Raises:
        UserError: the space is no Box of one dimension, or lacks bounds.
    """

    middle: Tensor
    half_range: Tensor

    def __init__(
        self, space: gymnasium.Space[Any], *, unbounded: bool = False, saved: bool = False
    ):
        super().__init__()
        match space:
            case gymnasium.spaces.Box(shape=(size,)) if unbounded or bounded(space).all():
                self.size = size
            case _:
                raise UserError(
                    "trainer: a policy of bounded actions needs continuous actions within bounds "
                    f"(a Box of one dimension), and this environment's are {space}; use "
                    "trainer_type: ppo"
                )
        scaled = bounded(space)
        self.is_bounded = bool(scaled.all())
        low, high = (
            torch.as_tensor(np.where(scaled, bound, other), dtype=torch.float64)
            for bound, other in ((space.low, -1.0), (space.high, 1.0))
        )
        self.register_buffer("middle", ((high + low) / 2.0).float(), persistent=saved)
        self.register_buffer("half_range", ((high - low) / 2.0).float(), persistent=saved)

    def forward(self, actions: Tensor) -> Tensor:
        """Actions as the environment's space has them, (B, A)."""
        return self.middle + self.half_range * actions


def to_environment(actions: Tensor, space: gymnasium.Space[Any]) -> NDArray[Any]:
    """Actions as the environment takes them: an array, within a Box, or counted from a start.

    Raises:
        NonFiniteError: one is NaN.
    """
    chosen = within(actions.cpu(), space)
    if chosen.isnan().any():
        raise NonFiniteError(
            "the policy's actions are NaN: a setting of its encoders is out of all proportion, or "
            "its weights are"
        )
    return chosen.numpy()


def within(actions: Tensor, space: gymnasium.Space[Any]) -> Tensor:
    """The same as a tensor, for actions on the CPU."""
    match space:
        case gymnasium.spaces.Box():
            low, high = (
                torch.as_tensor(bound, dtype=actions.dtype) for bound in (space.low, space.high)
            )
            return actions.clamp(low, high)
        case gymnasium.spaces.Discrete():
            return actions + int(space.start)
        case gymnasium.spaces.MultiDiscrete():
            return actions + torch.as_tensor(space.start)
    return actions
