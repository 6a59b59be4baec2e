"""Advantages and returns of a rollout, and how well a critic foresees them."""

from __future__ import annotations

import torch
from torch import Tensor

_EPSILON = 1e-8


@torch.no_grad()
def gae(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    done: Tensor,
    *,
    gamma: float,
    lambd: float,
) -> tuple[Tensor, Tensor]:
    """Estimate advantages by generalized advantage estimation (Schulman et al. 2016, eq. 11-16).

    A terminated episode is worth nothing after its end; a truncated one would have gone on, so it
    is bootstrapped with the value of its own last observation. Neither sees rewards of the episode
    that follows it in the same column.

    Args:
        rewards: The reward of each step, (T, N) float.
        values: The critic's value of the observation each step started from, (T, N).
        next_values: The critic's value of the observation each step truly led to, (T, N): at an
            episode's end the final observation, not the first of the next episode. Ignored where
            `terminated`.
        terminated: The episode ended in a terminal state, (T, N) bool.
        done: The episode ended, terminated or truncated, (T, N) bool; true wherever `terminated`
            is.
        gamma: The discount per step, from 0 to 1.
        lambd: How far rewards are trusted rather than the critic: 0 looks one step ahead, 1 is
            the discounted return less the value.

    Returns:
        The advantages and the returns (advantages + values), both (T, N), without gradient.
    """
    # delta_t = r_t + gamma V(s_{t+1}) - V(s_t)    with V = 0 at terminal states
    advantages = rewards + gamma * next_values.masked_fill(terminated, 0) - values
    discounts = gamma * lambd * (~done).to(advantages.dtype)
    # A_t = delta_t + gamma lambda A_{t+1}    within an episode
    for t in reversed(range(len(advantages) - 1)):
        advantages[t].addcmul_(discounts[t], advantages[t + 1])
    return advantages, advantages + values


@torch.no_grad()
def leave_one_out(returns: Tensor, groups: Tensor) -> Tensor:
    """Advantages over the mean return of the others of a group (Kool et al. 2019, eq. 8).

    That mean is a baseline which the transition's own action has no part in, and knows all that
    makes the group easy or hard. With antithetic noise the other of a pair has a part in it, which
    lengthens the gradient by n / (n - 1) and does not turn it.

    Args:
        returns: (M,).
        groups: (M,) int64, the number of the group that each belongs to.

    Returns:
        (M,); 0 for the only one of a group.
    """
    size = torch.bincount(groups)[groups].to(returns.dtype)
    total = torch.zeros(int(groups.max()) + 1, dtype=returns.dtype, device=returns.device)
    total = total.index_add_(0, groups, returns)[groups]
    # R_i - sum_{j != i} R_j / (n - 1)
    return torch.where(size > 1, returns - (total - returns) / (size - 1).clamp(min=1), 0.0)


def normalize(advantages: Tensor, among: Tensor | None = None) -> Tensor:
    """Shift and scale to mean 0 and (biased) standard deviation 1.

    Equal values, a single one included, become 0.

    Args:
        advantages: Any shape; the statistics are taken over all entries, so leave out padding.
        among: Those that the statistics are taken over instead.

    Returns:
        A tensor of the same shape.
    """
    std, mean = torch.std_mean(advantages if among is None else among, correction=0)
    return (advantages - mean) / (std + _EPSILON)


def explained_variance(returns: Tensor, values: Tensor) -> float:
    """Share of the returns' variance that the values foresee.

    1 - Var[returns - values] / Var[returns]: 1 is a perfect critic, 0 one as good as any constant,
    below 0 worse than that. When all returns are equal there is nothing to foresee, the quotient is
    undefined, and the answer is 0.

    Args:
        returns: Any shape with at least one entry.
        values: The critic's predictions of them, same shape.
    """
    # Relative to the first, so that equal returns have no variance left over from rounding.
    total = (returns - returns.reshape(-1)[0]).var(correction=0).item()
    if total == 0:
        return 0.0
    return 1 - (returns - values).var(correction=0).item() / total
