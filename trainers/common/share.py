"""A process's share of what a run's N environments have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Rows = TypeVar("Rows", Tensor, NDArray[np.int64])


@dataclass(frozen=True)
class Share:
    """The environments from `first` on of a run's N, which are stepped by this process.

    Attributes:
        first: number of the first one, from 0.
        count: n, of one's own.
        total: N, of the whole run.
    """

    first: int
    count: int
    total: int

    @classmethod
    def whole(cls, count: int) -> Share:
        """All of them."""
        return cls(0, count, count)

    @property
    def is_whole(self) -> bool:
        """Whether there are no others."""
        return self.count == self.total

    def drawn(self, draw: Callable[..., Tensor], shape: tuple[int, ...], **options: Any) -> Tensor:
        """Random numbers of one's own environments, which are the same whoever has the others.

        They are drawn for all of them, which costs little, and cut.

        Args:
            draw: a function of a shape and of the options, such as `torch.randn`.
            shape: (n, ...) of what is returned.
            options: those of `draw`.
        """
        every = draw((self.total, *shape[1:]), **options)
        return every[self.first : self.first + self.count]

    def own(self, rows: Rows) -> tuple[Rows, float]:
        """One's own among transitions, and how large a part of them all they are.

        Args:
            rows: (B,) in T steps of all environments, step * N + environment.

        Returns:
            (b,) in T steps of one's own, and b / B. Where none are one's own it is one row that
            weighs 0, as nothing can be learned from no row at all.
        """
        if self.is_whole:
            return rows, 1.0
        step, environment = rows // self.total, rows % self.total - self.first
        among = (environment >= 0) & (environment < self.count)
        own = (step * self.count + environment)[among]
        return (own, len(own) / len(rows)) if len(own) else (step[:1] * self.count, 0.0)

    def part(self, rows: Tensor, groups: Tensor) -> Tensor:
        """An equal part of a minibatch, whoever's environments it is from.

        Args:
            rows: (B,) of the minibatch.
            groups: (B,) numbers of what stays together, and is side by side.

        Returns:
            (b,) rows: B n / N of them, as near as whole groups allow; that can be none.
        """
        _, lengths = groups.unique_consecutive(return_counts=True)
        ends = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
        limits = torch.tensor([self.first, self.first + self.count]) * (len(rows) / self.total)
        begin, end = (ends - limits[:, None]).abs().argmin(1)
        return rows[ends[begin] : ends[end]]
