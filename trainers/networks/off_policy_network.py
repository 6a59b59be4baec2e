"""The contract of a policy that learns off-policy: an actor, critics, and targets."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from trainers.networks.actions import ActionScaling
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.policy_network import PolicyNetwork


class OffPolicyNetwork(PolicyNetwork, ABC):
    """An actor of bounded actions, and critics of them, with targets.

    Attributes:
        scale: actions in [-1, 1], in which the networks live, to the environment's bounds.
        critic_sees: names of the observations that critics see.
    """

    scale: ActionScaling
    critic_sees: tuple[str, ...]

    @abstractmethod
    def encode_frames(self, frames: dict[str, Tensor]) -> FrameFeatures:
        """The actor's features of U frames by name, (U, H, W, C)."""

    @abstractmethod
    def update_targets(self) -> None:
        """Moves the targets towards what learns."""


class TargetAverage:
    """Polyak averaging: target += tau (online - target), buffers copied.

    Args:
        target: what follows.
        online: what it follows.
        tau: how far it goes at a time.
    """

    def __init__(self, target: nn.Module, online: nn.Module, tau: float):
        self._average = get_ema_multi_avg_fn(1.0 - tau)
        self._pairs = list(target.parameters()), list(online.parameters())
        self._target, self._online = target, online

    def update(self) -> None:
        """Moves the target's parameters."""
        self._average(*self._pairs, 0)

    def copy_buffers(self) -> None:
        """Makes the target's buffers, such as statistics of observations, those of the other."""
        # Looked up anew: a module that moves to another device keeps its parameters alone.
        for theirs, ours in zip(self._target.buffers(), self._online.buffers(), strict=True):
            theirs.copy_(ours)
