"""Rewards scaled to what a critic can learn, whatever the environment's own scale."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from encoders.normalizer import RunningNormalizer

CLIP = 10.0


class RewardNormalizer:
    """Divides rewards by the standard deviation of the discounted returns seen so far.

    The sum of past rewards G_t = gamma G_(t-1) + r_t, begun anew with each episode, stands for the
    return (Engstrom et al. 2020, arXiv:2005.12729, "reward scaling"). The rewards of a rollout,
    which is learned from as a whole, share one scale. They are not shifted, for that would change
    what is worth doing.

    Args:
        count: N environments.
        gamma: the discount factor.
    """

    def __init__(self, count: int, gamma: float):
        self._gamma = gamma
        self._carried = np.zeros(count)  # gamma G of the step before; 0 where an episode begins
        self._returns = RunningNormalizer(1)

    @property
    def deviation(self) -> float:
        """Standard deviation of the returns, by which rewards are divided."""
        return self._returns.deviation.item()

    def __call__(
        self,
        rewards: Tensor,
        done: Tensor,
        all_rows: Callable[[Tensor], Tensor] = lambda own: own,
    ) -> Tensor:
        """Learns the scale from the next T steps of N environments, and scales them.

        Args:
            rewards: (T, N).
            done: (T, N) bool, the episode ended with that step.
            all_rows: adds the rows of other processes, whose rewards have the same scale.

        Returns:
            (T, N), within +-10.
        """
        sums = rewards.to("cpu", torch.float64, copy=True).numpy()
        discounts = np.where(done.cpu().numpy(), 0.0, self._gamma)
        carried = self._carried
        for row, discount in enumerate(discounts):
            sums[row] += carried
            carried = discount * sums[row]
        self._carried = carried
        self._returns.update(all_rows(torch.from_numpy(sums).reshape(-1, 1)))
        return (rewards / self.deviation).clamp(-CLIP, CLIP)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly."""
        returns = {name: value.clone() for name, value in self._returns.state_dict().items()}
        return {"carried": self._carried, "returns": returns}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state."""
        self._carried = state["carried"]
        self._returns.load_state_dict(state["returns"])
