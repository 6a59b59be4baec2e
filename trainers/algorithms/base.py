"""The contract of a trainer (algorithm)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from torch import Tensor

from trainers.common.trainer_settings import TrainerSettings
from trainers.distributed.states import Axes
from trainers.networks.factory import NetworkFactory
from trainers.networks.policy_network import PolicyNetwork

__all__ = ("Algorithm", "TrainerSettings")


class Algorithm(Protocol):
    """Learns by collecting experience and updating its policy, in turns.

    Built as `cls(factory, settings, env_runner, generator, device)`, from a `NetworkFactory`, its
    own settings, an `EnvRunner`, the source of its randomness and the torch device.

    Attributes:
        Settings: its model, of `TrainerSettings`.
        tags: what each statistic of `update` says, by its tag, for the reference.
        policy: what acts, and what is saved as the weights.
        state_axes: which axis of its state's arrays has an entry for each environment; declared by
            those that can learn in several processes (see `trainers.distributed`).
        collection_steps: steps that `collect` takes, over all environments.
    """

    Settings: ClassVar[type[TrainerSettings]]
    tags: ClassVar[Mapping[str, str]]
    state_axes: ClassVar[Axes]
    policy: PolicyNetwork
    collection_steps: int

    @staticmethod
    def build_policy(factory: NetworkFactory, settings: Any) -> PolicyNetwork:
        """A new policy, with weights of the same names and shapes as those of `policy`.

        All that acting needs: no optimizer, no experience, no environment.

        Args:
            factory: builds its networks.
            settings: the algorithm's.

        Raises:
            UserError: the settings don't fit what is observed or done.
        """

    def collect(self) -> None:
        """Steps the environments until there is enough for an update; changes no weights."""

    def update(self, run_fraction: float) -> Mapping[str, float]:
        """Learns from what was collected.

        Args:
            run_fraction: the share of the run that is over, in [0, 1], for schedules.

        Returns:
            Statistics by their TensorBoard tag.

        Raises:
            NonFiniteError: a loss is NaN or infinite.
            StopRequested: `env_runner.check_stop`, which a long update should call now and then,
                says that the run is to stop.
            Whatever is raised, what the update changed is not used: the run is saved as before it.
        """

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights that is needed to go on exactly.

        It may share memory with what `collect` leaves alone, such as optimizers and a replay
        buffer: a state from before a collection is saved where that is stopped half way. It is
        copied before an update, unless it is much larger than the weights.
        """

    def load_state_dict(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """Goes back to a state."""
