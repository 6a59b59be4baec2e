"""The contract of a trainer (algorithm), and what all of them have in their settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from pydantic import BaseModel, Field
from torch import Tensor, nn

from trainers.networks.observations import Observations


class TrainerSettings(BaseModel, frozen=True, extra="forbid"):
    """How long to train, and how often to report and to save."""

    max_steps: int = Field(
        500_000, ge=1, description="Steps of the whole run, over all environments."
    )
    summary_freq: int = Field(10_000, ge=1, description="Steps between two summaries.")
    checkpoint_interval: int = Field(100_000, ge=1, description="Steps between two checkpoints.")
    keep_checkpoints: int = Field(5, ge=1, description="Checkpoints kept, next to the best.")


class Algorithm(Protocol):
    """Learns by collecting experience and updating its policy, in turns.

    Built as `cls(factory, settings, env_runner, generator, device)`, from a `NetworkFactory`, its
    own settings, an `EnvRunner`, the source of its randomness and the torch device.

    Attributes:
        policy: what is saved as the weights, and evaluated.
    """

    policy: nn.Module

    def initial_state(self, count: int) -> Tensor:
        """What the policy remembers where episodes begin, (count, m); m is 0 without memory."""

    def act(self, observations: Observations, *, deterministic: bool) -> tuple[Tensor, Tensor]:
        """Acts for evaluation.

        Args:
            observations: B observations, with what is remembered before them.
            deterministic: the policy's best action, or one drawn as at the end of training.

        Returns:
            Actions (B, ...), and what is to be remembered of each, (B, m).
        """

    def collect(self) -> None:
        """Plays until there is enough experience for an update; changes no weights."""

    def update(self, progress: float) -> Mapping[str, float]:
        """Learns from what was collected.

        Args:
            progress: the share of the run that is over, in [0, 1], for schedules.

        Returns:
            Statistics by their TensorBoard tag.

        Raises:
            NonFiniteError: a loss is NaN or infinite; the weights are as before that step.
        """

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights that is needed to go on exactly.

        It may share memory with what `collect` leaves alone, such as optimizers and a replay
        buffer: a state from before a collection is saved where that is stopped half way.
        """

    def load_state_dict(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """Goes back to a state."""
