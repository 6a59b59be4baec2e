"""Standardisation with moments learned from the data seen so far."""

from __future__ import annotations

import torch
from torch import nn

_LEAST_VARIANCE = 1e-8
_ROUNDING = 1e-12  # a relative deviation that is none


class RunningNormalizer(nn.Module):
    """Standardises vectors by the mean and variance of all batches it was updated with.

    The moments are buffers, hence saved with the weights; float64, because a running sum over
    millions of samples outgrows float32. Before the first update nothing but the clip acts.

    An input that has been constant so far has no scale yet: it is shifted and not scaled, as by
    scikit-learn's `StandardScaler`, and those samples count on with the variance 1. So when it
    first moves, by d, what comes out moves by about d. By the moments alone it would jump, however
    little it moved: where a fraction p of all samples has, they stand sqrt((1 - p) / p) deviations
    from the mean, which a least deviation prevents for inputs of one scale only. While the input
    goes on varying, its own variance takes over.

    Args:
        size: Length n of the vectors.
        clip: Largest absolute value that comes out.

    Attributes:
        mean: (n,) float64.
        variance: (n,) float64, of the population (divided by the count); 1 while it is constant.
        count: () float64, vectors seen.
    """

    mean: torch.Tensor
    variance: torch.Tensor
    count: torch.Tensor

    def __init__(self, size: int, clip: float = 5.0) -> None:
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @property
    def deviation(self) -> torch.Tensor:
        """(n,) float64, what vectors are divided by; never zero."""
        return (self.variance + _LEAST_VARIANCE).sqrt()

    @torch.no_grad()
    def update(self, batch: torch.Tensor) -> None:
        """Merges the moments of a batch (B, n) into the running ones; an empty one changes nothing.

        Source: Chan, Golub & LeVeque 1979, "Updating formulae and a pairwise algorithm for
        computing sample variances".
        """
        added = len(batch)
        if added == 0:
            return
        values = batch.to(torch.float64)
        total = self.count + added
        mean, variance = values.mean(0), values.var(0, correction=0)
        delta = mean - self.mean
        # M_ab = M_a + M_b + delta^2 n_a n_b / n, with M the sum of squared deviations
        squares = (
            self.variance * self.count + variance * added + delta**2 * self.count * added / total
        )
        spread = variance + torch.where(self.count > 0, delta, 0.0) ** 2
        constant = spread <= (_ROUNDING * mean) ** 2
        self.mean += delta * added / total
        self.variance.copy_(torch.where(constant, self.variance, squares / total))
        self.count.copy_(total)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """(B, n) -> standardised, clipped to +-clip, (B, n) float32; changes no moment."""
        standard = (values.to(torch.float64) - self.mean) / self.deviation
        return standard.clamp(-self.clip, self.clip).to(torch.float32)
