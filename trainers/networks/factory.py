"""Builds the networks of a run, or of a saved policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
from torch import nn

from trainers.common.errors import UserError, suggestion
from trainers.networks.network import Network, NetworkSettings
from trainers.networks.recurrent import MemorySettings

EncoderBuilder = Callable[[str, gymnasium.Space[Any], NetworkSettings], nn.Module]
"""An observation's name and space, and what follows its encoder -> the encoder."""


class NetworkFactory:
    """Knows what is observed and done, and how each observation is encoded.

    Args:
        observation_space: of one environment.
        action_space: of one environment.
        build_encoder: a new encoder of an observation.
        privileged: names of the observations that only a critic may see.
    """

    def __init__(
        self,
        observation_space: gymnasium.spaces.Dict,
        action_space: gymnasium.Space[Any],
        build_encoder: EncoderBuilder,
        privileged: frozenset[str] = frozenset(),
    ):
        self.observation_space = observation_space
        self.action_space = action_space
        self.privileged = privileged
        self._build_encoder = build_encoder

    def check_name(self, name: str, path: str) -> None:
        """Refuses observations that there are not.

        Raises:
            UserError: with the key of the run file and the nearest name.
        """
        if name not in self.observation_space.spaces:
            raise UserError(
                f"{path}: the environment has no observation {name!r}; "
                f"{suggestion(name, self.observation_space.spaces)}"
            )

    def network(
        self,
        settings: NetworkSettings,
        names: Sequence[str],
        memory: MemorySettings | None = None,
    ) -> Network:
        """A new network on some of the observations.

        Args:
            settings: what follows the encoders.
            names: of the observations.
            memory: what follows the trunk, if anything.

        Raises:
            UserError: an encoder does not fit its observation.
        """
        spaces = {name: self.observation_space[name] for name in names}
        encoders = {
            name: self._build_encoder(name, space, settings) for name, space in spaces.items()
        }
        return Network(encoders, spaces, settings, memory)

    def encoders(self, settings: NetworkSettings, names: Sequence[str]) -> Network:
        """A new network without hidden layers, whose features others go on with.

        Args:
            settings: what follows.
            names: of the observations.

        Raises:
            UserError: an encoder does not fit its observation.
        """
        return self.network(settings.model_copy(update={"num_layers": 0}), names)
