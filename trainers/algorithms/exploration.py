"""Noise that a deterministic policy explores with."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Protocol

import torch
from pydantic import BaseModel, Field
from torch import Tensor

from trainers.algorithms.schedules import CONSTANT, Schedule
from trainers.common.share import Share


class _NoiseSettings(BaseModel, frozen=True, extra="forbid"):
    sigma: float = Field(
        0.1,
        ge=0.0,
        description="Size of the noise to begin with, in the units of actions scaled to [-1, 1].",
    )
    schedule: Schedule = Field(CONSTANT, description="Course of sigma over the run.")


class GaussianSettings(_NoiseSettings, frozen=True, extra="forbid"):
    """Noise drawn anew at every step."""

    type: Literal["gaussian"] = Field("gaussian", description="Kind of noise.")

    def build(self, shape: tuple[int, int], device: torch.device) -> Gaussian:
        """The noise of N environments with actions of length A: `shape` is (N, A)."""
        return Gaussian(shape, device)

    def deviation(self) -> float:
        """The standard deviation, as a multiple of sigma."""
        return 1.0


class OrnsteinUhlenbeckSettings(_NoiseSettings, frozen=True, extra="forbid"):
    """Noise that drifts, for systems with inertia (Lillicrap et al. 2015)."""

    type: Literal["ornstein_uhlenbeck"] = Field(description="Kind of noise.")
    theta: float = Field(
        0.15, gt=0.0, description="How fast it drifts back to 0, per step: 1 / theta steps."
    )

    def build(self, shape: tuple[int, int], device: torch.device) -> OrnsteinUhlenbeck:
        """The noise of N environments with actions of length A: `shape` is (N, A)."""
        return OrnsteinUhlenbeck(shape, self.theta, device)

    def deviation(self) -> float:
        """The standard deviation in the long run, as a multiple of sigma."""
        return 1.0 / math.sqrt(2.0 * self.theta)


NoiseSettings = Annotated[GaussianSettings | OrnsteinUhlenbeckSettings, Field(discriminator="type")]


class Noise(Protocol):
    """Noise of sigma 1, for N environments at once.

    Attributes:
        state: of the process, (N, A); empty for noise that has none.
    """

    state: Tensor

    def sample(self, generator: torch.Generator, share: Share | None = None) -> Tensor:
        """The next noise, (N, A); of a share of environments that others draw for alike."""

    def restart(self, ended: Tensor) -> None:
        """Forgets what came before, where an episode ended (N,)."""


class Gaussian:
    """Independent normal numbers of standard deviation 1."""

    def __init__(self, shape: tuple[int, int], device: torch.device):
        self._shape = shape
        self.state = torch.empty(0, device=device)

    def sample(self, generator: torch.Generator, share: Share | None = None) -> Tensor:
        """See `Noise.sample`."""
        return _normal(self._shape, generator, share, self.state.device)

    def restart(self, ended: Tensor) -> None:
        """See `Noise.restart`; there is nothing to forget."""


class OrnsteinUhlenbeck:
    """The process dx = -theta x dt + dW from x = 0, seen at every step (Uhlenbeck & Ornstein 1930).

    Solved exactly from one step to the next, so that its standard deviation in the long run is
    1 / sqrt(2 theta) for any theta.
    """

    def __init__(self, shape: tuple[int, int], theta: float, device: torch.device):
        self._decay = math.exp(-theta)
        self._kick = math.sqrt(-math.expm1(-2.0 * theta) / (2.0 * theta))
        self.state = torch.zeros(shape, device=device)

    def sample(self, generator: torch.Generator, share: Share | None = None) -> Tensor:
        """See `Noise.sample`."""
        # x_{t+1} = exp(-theta) x_t + sqrt((1 - exp(-2 theta)) / (2 theta)) N(0, 1)
        kick = _normal(self.state.shape, generator, share, self.state.device)
        self.state = self._decay * self.state + self._kick * kick
        return self.state

    def restart(self, ended: Tensor) -> None:
        """See `Noise.restart`."""
        self.state = self.state.masked_fill(ended[:, None], 0.0)


def _normal(
    shape: tuple[int, ...], generator: torch.Generator, share: Share | None, device: torch.device
) -> Tensor:
    """Independent normal numbers of standard deviation 1."""
    share = share or Share.whole(shape[0])
    return share.drawn(torch.randn, shape, generator=generator, device=device)
