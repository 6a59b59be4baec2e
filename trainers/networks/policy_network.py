"""The contract of a policy: a network that acts, apart from whatever trains it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from trainers.networks.observations import Observations


class PolicyNetwork(nn.Module):
    """A policy, with whatever else is trained and saved beside it, such as critics.

    Attributes:
        sees: names of the observations that acting needs.
        state_size: m, length of the hidden state; 0 without memory.
    """

    sees: tuple[str, ...]
    state_size: int = 0

    def initial_state(self, count: int) -> Tensor:
        """Hidden states where episodes begin, (count, m)."""
        return next(self.parameters()).new_zeros(count, self.state_size)

    def act(
        self, observations: Observations, *, deterministic: bool, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Actions for B observations, with the hidden states before them in their `sequences`.

        A network has either `features` and `act_on`, of which this is made, or an `act` of its own;
        then nobody can learn from its features how sure its actions are.

        Args:
            observations: B of them.
            deterministic: the policy's best actions; or drawn as at the end of training.
            generator: the source of what is drawn.

        Returns:
            Actions (B, ...) in the units of the environment's space, and the hidden states (B, m)
            after them.
        """
        features, hidden_state = self.features(observations)
        return self.act_on(features, deterministic=deterministic, generator=generator), hidden_state

    def features(self, observations: Observations) -> tuple[Tensor, Tensor]:
        """What actions are chosen by, and the hidden states; see `act`.

        Returns:
            Features (B, F), and the hidden states (B, m) after the observations.

        Raises:
            NotImplementedError: the network has an `act` of its own.
        """
        raise NotImplementedError

    def act_on(
        self, features: Tensor, *, deterministic: bool, generator: torch.Generator
    ) -> Tensor:
        """Actions (B, ...) for features (B, F); see `act`.

        Raises:
            NotImplementedError: the network has an `act` of its own.
        """
        raise NotImplementedError

    def exploration_std(self) -> Tensor | None:
        """Standard deviations (A,) of what is added to the best actions where actions are drawn.

        In the units of the environment's space, to whose bounds the sum is held. None: actions are
        drawn in another way.
        """
        return None

    def current_weights(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Weights that a former version of the network may have saved, as `state_dict` has them.

        Those of the present version, and whatever else they may be, stay as they are.
        """
        return dict(weights)

    def update_statistics(self, vectors: dict[str, Tensor]) -> None:
        """Shows vector observations (B, n) by name to the encoders that standardise."""
