"""Between a network's actions and an environment's."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trainers.common.errors import UserError


class ActionScaling(nn.Module):
    """Actions (B, A) in [-1, 1] to the bounds of a space; holds no weights.

    Args:
        space: of the environment's actions.

    Attributes:
        size: A.

    Raises:
        UserError: the space has no bounds.
    """

    _low: Tensor
    _high: Tensor

    def __init__(self, space: gymnasium.Space[Any]):
        super().__init__()
        box = _bounded(space)
        self.size = box.shape[0]
        self.register_buffer("_low", torch.as_tensor(box.low), persistent=False)
        self.register_buffer("_high", torch.as_tensor(box.high), persistent=False)

    def forward(self, actions: Tensor) -> Tensor:
        """Actions as the environment's space has them, (B, A)."""
        return self._low + (actions + 1.0) / 2.0 * (self._high - self._low)


def to_environment(actions: Tensor, space: gymnasium.Space[Any]) -> NDArray[Any]:
    """Actions as the environment takes them: an array, within a Box, or from a Discrete's start."""
    return within(actions.cpu(), space).numpy()


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
    return actions


def _bounded(space: gymnasium.Space[Any]) -> gymnasium.spaces.Box:
    match space:
        case gymnasium.spaces.Box(shape=(_,)) if np.isfinite([space.low, space.high]).all():
            return space
    raise UserError(
        "trainer: a policy of bounded actions needs continuous actions within bounds (a Box of "
        f"one dimension), and this environment's are {space}; use trainer_type: ppo"
    )
