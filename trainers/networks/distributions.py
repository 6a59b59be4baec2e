"""Distributions over actions, as values.

A distribution is what a policy returns: a frozen pair of tensors without hidden state, so that the
old and the new one of an update can stand side by side. All sums over the dimensions of an action
happen here; whoever uses a distribution sees one number per action.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from trainers.common.share import Share

_LOG_2, _LOG_2_PI = math.log(2), math.log(2 * math.pi)
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(24)
"""Of a Gauss-Hermite rule: E f(x) = sum_k w_k f(x_k) / sqrt(2 pi) for a standard normal x."""


class Distribution(Protocol):
    """A distribution over actions in each of B rows."""

    def sample(
        self, generator: torch.Generator | None = None, share: Share | None = None
    ) -> Tensor:
        """Draw one action per row; no gradient flows through it.

        Args:
            generator: The source of randomness, on the distribution's device; None is torch's own.
            share: Which of more rows these are, that other processes draw in the same way.
        """
        ...

    def mode(self) -> Tensor:
        """Likeliest action of each row, shaped as `sample` shapes it."""
        ...

    def log_prob(self, actions: Tensor) -> Tensor:
        """Log density (or log probability) of one action per row, (B,), in nats."""
        ...

    def entropy(self) -> Tensor:
        """Entropy (or differential entropy) of each row, (B,), in nats."""
        ...

    def kl(self, other: Self) -> Tensor:
        """KL(self || other) of each row, (B,), in nats."""
        ...

    def detach(self) -> Self:
        """The same distribution, cut from the graph that computed it."""
        ...

    def __getitem__(self, rows: slice | Tensor) -> Self:
        """Distribution of some rows: a slice, a mask (B,) or indices (M,)."""
        ...

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Distribution of all rows of several, which one policy made."""
        ...


@dataclass(frozen=True, eq=False)
class DiagonalGaussian:
    """Independent normal distributions, one per dimension of a continuous action.

    Attributes:
        mean: The means, (B, A).
        log_std: The logarithms of the standard deviations: (B, A), or (A,) when all rows share
            them.

    Raises:
        ValueError: `log_std` has another shape.
    """

    mean: Tensor
    log_std: Tensor

    def __post_init__(self) -> None:
        if self.log_std.shape not in (self.mean.shape, self.mean.shape[-1:]):
            raise ValueError(
                f"log_std has shape {tuple(self.log_std.shape)}; with means of shape "
                f"{tuple(self.mean.shape)} it must be that or {tuple(self.mean.shape[-1:])}"
            )

    def sample(
        self, generator: torch.Generator | None = None, share: Share | None = None
    ) -> Tensor:
        """Draw one action per row, (B, A); see `Distribution.sample`."""
        with torch.no_grad():
            noise = (share or Share.whole(len(self.mean))).drawn(
                torch.randn,
                self.mean.shape,
                generator=generator,
                dtype=self.mean.dtype,
                device=self.mean.device,
            )
            return noise.mul_(self.log_std.exp()).add_(self.mean)

    def mode(self) -> Tensor:
        """Mean (B, A)."""
        return self.mean

    def log_prob(self, actions: Tensor) -> Tensor:
        """Log density of one action per row, (B,).

        Args:
            actions: (B, A).

        Raises:
            ValueError: `actions` has another shape than the means; broadcasting would silently
                compare each action with every row.
        """
        if actions.shape != self.mean.shape:
            raise ValueError(
                f"actions have shape {tuple(actions.shape)}, the distribution's means "
                f"{tuple(self.mean.shape)}; they must be the same"
            )
        # log p(a) = -1/2 sum_i ((a_i - mu_i) / sigma_i)^2 - sum_i log sigma_i - A/2 log 2 pi
        deviation = (actions - self.mean) * torch.exp(-self.log_std)
        log_scale = self.log_std.sum(-1) + 0.5 * _LOG_2_PI * self.mean.shape[-1]
        return -0.5 * deviation.square().sum(-1) - log_scale

    def entropy(self) -> Tensor:
        """Differential entropy of each row, (B,); it may be negative."""
        # H = sum_i log sigma_i + A/2 (1 + log 2 pi)
        constant = 0.5 * (1 + _LOG_2_PI) * self.mean.shape[-1]
        return (self.log_std.sum(-1) + constant).expand(self.mean.shape[0])

    def kl(self, other: DiagonalGaussian) -> Tensor:
        """KL(self || other) of each row, (B,)."""
        # KL(p || q) = 1/2 sum_i (s_i - 1 - log s_i + ((mu_p - mu_q)_i / sigma_q,i)^2)
        # with s = (sigma_p / sigma_q)^2; expm1 keeps s - 1 - log s exact for close distributions,
        # where a trust region measures it.
        log_ratio = 2 * (self.log_std - other.log_std)
        spread = (torch.expm1(log_ratio) - log_ratio).sum(-1)
        deviation = (self.mean - other.mean) * torch.exp(-other.log_std)
        return 0.5 * (spread + deviation.square().sum(-1))

    def detach(self) -> Self:
        """The same distribution, cut from the graph that computed it."""
        return replace(self, mean=self.mean.detach(), log_std=self.log_std.detach())

    def __getitem__(self, rows: slice | Tensor) -> Self:
        """Distribution of some rows: a slice, a mask (B,) or indices (M,)."""
        shared = self.log_std.ndim < self.mean.ndim
        log_std = self.log_std if shared else self.log_std[rows]
        return replace(self, mean=self.mean[rows], log_std=log_std)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Distribution of all rows of several, which one policy made."""
        log_std = parts[0].log_std
        if log_std.ndim == parts[0].mean.ndim:
            log_std = torch.cat([part.log_std for part in parts])
        return cls(torch.cat([part.mean for part in parts]), log_std)


@dataclass(frozen=True, eq=False)
class TanhGaussian(DiagonalGaussian):
    """The tanh of independent normal distributions: actions within (-1, 1).

    An action tanh(u) is given and taken as u, for which `sample`, `mode` and `log_prob` stand:
    rounded, tanh(u) is 1 from u = 9 on, and would not tell which u it came from. The divergence of
    two is that of their normals: tanh maps one to one.

    See "Soft Actor-Critic" (Haarnoja et al. 2018, arXiv:1801.01290), appendix C.
    """

    def log_prob(self, actions: Tensor) -> Tensor:
        """Log density of the actions tanh(u), (B,); arguments and errors as the Gaussian's.

        Args:
            actions: u, (B, A).
        """
        # log p(a) = log N(u) - sum_i log |da_i / du_i|
        return super().log_prob(actions) - _log_slope(actions).sum(-1)

    def entropy(self) -> Tensor:
        """Differential entropy of each row, (B,); at most A log 2, that of uniform actions.

        By a quadrature that is good to 0.001 nats a dimension for deviations up to 2, and to 0.05
        for those up to 5.
        """
        # H[tanh u] = H[u] + sum_i E log |da_i / du_i|, the expectation by quadrature
        nodes, weights = (self.mean.new_tensor(values) for values in (_NODES, _WEIGHTS))
        u = self.mean[..., None] + self.log_std.exp()[..., None] * nodes
        expected = (_log_slope(u) @ weights).sum(-1) / math.sqrt(2 * math.pi)
        return super().entropy() + expected


def _log_slope(u: Tensor) -> Tensor:
    """Logarithm of d tanh(u) / du, of the same shape, and finite wherever u is."""
    # 1 - tanh(u)^2 = (2 e^-u / (1 + e^-2u))^2
    return 2.0 * (_LOG_2 - u - F.softplus(-2.0 * u))


@dataclass(frozen=True, eq=False)
class Categorical:
    """A choice between K discrete actions.

    Attributes:
        logits: Finite unnormalized log probabilities, (B, K).
    """

    logits: Tensor

    def sample(
        self, generator: torch.Generator | None = None, share: Share | None = None
    ) -> Tensor:
        """Draw one action per row, (B,) int64; see `Distribution.sample`.

        Raises:
            RuntimeError: A logit is not finite.
        """
        with torch.no_grad():
            probabilities = F.softmax(self.logits, -1)
            if share is None or share.is_whole:
                return torch.multinomial(probabilities, 1, generator=generator).squeeze(-1)
            # As multinomial does it: of exponential clocks with these rates the first to ring.
            clocks = share.drawn(
                lambda shape: probabilities.new_empty(shape).exponential_(generator=generator),
                probabilities.shape,
            )
            return (probabilities / clocks).argmax(-1)

    def mode(self) -> Tensor:
        """Likeliest action of each row, (B,) int64."""
        return self.logits.argmax(-1)

    def log_prob(self, actions: Tensor) -> Tensor:
        """Log probability of one action per row, (B,).

        Args:
            actions: (B,) int64.
        """
        # The cross entropy with a one-hot target: log-softmax and selection in one fused kernel.
        return -F.cross_entropy(self.logits, actions, reduction="none")

    def entropy(self) -> Tensor:
        """Entropy of each row, (B,), from 0 to log K."""
        log_p = F.log_softmax(self.logits, -1)
        return -(log_p.exp() * log_p).sum(-1)

    def kl(self, other: Categorical) -> Tensor:
        """KL(self || other) of each row, (B,)."""
        log_p = F.log_softmax(self.logits, -1)
        log_q = F.log_softmax(other.logits, -1)
        return (log_p.exp() * (log_p - log_q)).sum(-1)

    def detach(self) -> Categorical:
        """The same distribution, cut from the graph that computed it."""
        return Categorical(self.logits.detach())

    def __getitem__(self, rows: slice | Tensor) -> Categorical:
        """Distribution of some rows: a slice, a mask (B,) or indices (M,)."""
        return Categorical(self.logits[rows])

    @classmethod
    def concatenate(cls, parts: Sequence[Categorical]) -> Categorical:
        """Distribution of all rows of several, which one policy made."""
        return cls(torch.cat([part.logits for part in parts]))


@dataclass(frozen=True, eq=False)
class MultiCategorical:
    """Independent choices, one for each of the A numbers of a discrete action.

    Attributes:
        logits: Of all choices side by side, (B, K_1 + ... + K_A), as `Categorical` has them.
        sizes: K_1, ..., K_A.
    """

    logits: Tensor
    sizes: tuple[int, ...]

    def sample(
        self, generator: torch.Generator | None = None, share: Share | None = None
    ) -> Tensor:
        """Draw one action per row, (B, A) int64; see `Categorical.sample`."""
        return torch.stack([choice.sample(generator, share) for choice in self._choices], -1)

    def mode(self) -> Tensor:
        """Likeliest action of each row, (B, A) int64."""
        return torch.stack([choice.mode() for choice in self._choices], -1)

    def log_prob(self, actions: Tensor) -> Tensor:
        """Log probability of one action per row, (B,).

        Args:
            actions: (B, A) int64.
        """
        pairs = zip(self._choices, actions.unbind(-1), strict=True)
        return torch.stack([choice.log_prob(chosen) for choice, chosen in pairs]).sum(0)

    def entropy(self) -> Tensor:
        """Entropy of each row, (B,)."""
        return torch.stack([choice.entropy() for choice in self._choices]).sum(0)

    def kl(self, other: MultiCategorical) -> Tensor:
        """KL(self || other) of each row, (B,)."""
        pairs = zip(self._choices, other._choices, strict=True)
        return torch.stack([ours.kl(theirs) for ours, theirs in pairs]).sum(0)

    def detach(self) -> MultiCategorical:
        """The same distribution, cut from the graph that computed it."""
        return MultiCategorical(self.logits.detach(), self.sizes)

    def __getitem__(self, rows: slice | Tensor) -> MultiCategorical:
        """Distribution of some rows: a slice, a mask (B,) or indices (M,)."""
        return MultiCategorical(self.logits[rows], self.sizes)

    @classmethod
    def concatenate(cls, parts: Sequence[MultiCategorical]) -> MultiCategorical:
        """Distribution of all rows of several, which one policy made."""
        return cls(torch.cat([part.logits for part in parts]), parts[0].sizes)

    @property
    def _choices(self) -> list[Categorical]:
        return [Categorical(logits) for logits in self.logits.split(self.sizes, -1)]
