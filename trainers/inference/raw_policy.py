"""A policy from what sensors deliver to what its actions mean: all of it is one module."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from encoders.raw_inputs import RawInput, raw_input
from envs.deployment import Correction, Meaning
from envs.views import View
from trainers.common.errors import UserError
from trainers.inference.policy import Policy
from trainers.networks.actions import within
from trainers.networks.observations import Observations, is_frame
from trainers.networks.off_policy_network import OffPolicyNetwork
from trainers.networks.recurrent import Sequences

ACTION, UNBOUNDED_ACTION = "action", "unbounded_action"
HIDDEN_STATE, NEXT_HIDDEN_STATE = "hidden_state", "next_hidden_state"
EXPECTED_ERRORS, PROBABILITY, SURE = "expected_errors", "probability", "sure"

Arrays = dict[str, NDArray[Any]]


class RawPolicy(nn.Module):
    """The deterministic policy, from raw values to named outputs.

    Args:
        policy: acts; what it is made of is shared.
        meaning: of its actions; None: nothing but themselves.
        views: how its images are taken.
        correction: of what actions mean, where the camera is elsewhere than in training.

    Attributes:
        raw_inputs: by the name of the observation.
        views: the same.
        meaning: of its actions; None: nothing but themselves.
        state_size: m, length of the hidden state; 0 without memory.
        input_names: of what `forward` takes, in this order: the observations, and `hidden_state`
            where there is memory.
        card: what `sure` means; None: nobody knows how sure it is.
        output_names: of what it returns: `action`, the meaning's, `expected_errors`, `probability`
            and `sure` where they are known, `next_hidden_state`, and `unbounded_action` where
            exploration adds to actions that may be out of bounds.
        exploration_std: see `PolicyNetwork.exploration_std`.

    Raises:
        UserError: an observation has the name of something else.
    """

    def __init__(
        self,
        policy: Policy,
        meaning: Meaning | None,
        views: Mapping[str, View],
        correction: Correction | None = None,
    ):
        super().__init__()
        self.network, self.views = policy.network, dict(views)
        self.observation_space, self.action_space = policy.observation_space, policy.action_space
        self.raw_inputs = raw_inputs(policy.observation_space, views)
        self.meaning, self.confidence = meaning, policy.confidence
        self.card = None if policy.confidence is None else policy.confidence.card
        self.state_size = self.network.state_size
        self.exploration_std = self.network.exploration_std()
        self._quantities: _Quantities | None = None
        if meaning is not None:
            self._quantities = _Quantities(meaning, policy.action_space, correction)
        self.input_names = (*self.raw_inputs, *([HIDDEN_STATE] if self.state_size else []))
        self.output_names = self._output_names()
        names = (*self.input_names, *self.output_names)
        if len(set(names)) < len(names):
            raise UserError(
                f"an observation and something else have the same name, among {', '.join(names)}: "
                "rename the observation"
            )

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Raw values (B, ...), then the hidden state (B, m) -> the outputs (B, ...)."""
        frames: dict[str, Tensor] = {}
        vectors: dict[str, Tensor] = {}
        for (name, raw), value in zip(self.raw_inputs.items(), values, strict=False):
            space = self.observation_space[name]
            (frames if is_frame(space) else vectors)[name] = raw(value)
        count = values[0].shape[0]
        state = (
            values[-1] if self.state_size else values[0].new_zeros(count, 0, dtype=torch.float32)
        )
        observations = Observations(frames, vectors, sequences=Sequences.single(state))
        actions, after, judged = self._judged(observations)
        bounded = within(actions, self.action_space)
        outputs = {ACTION: bounded, NEXT_HIDDEN_STATE: after, UNBOUNDED_ACTION: actions, **judged}
        if self._quantities is not None:
            outputs[self._quantities.name] = self._quantities(bounded)
        return tuple(outputs[name] for name in self.output_names)

    def _judged(self, observations: Observations) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Best actions, the hidden states after them, and how sure they are, by name."""
        best: dict[str, Any] = {"deterministic": True, "generator": torch.Generator()}
        if self.confidence is None:
            return *self.network.act(observations, **best), {}
        features, after = self.network.features(observations)
        judged = self.confidence(features)
        names = (EXPECTED_ERRORS, PROBABILITY, SURE)
        return self.network.act_on(features, **best), after, dict(zip(names, judged, strict=True))

    @torch.no_grad()
    def run(self, raw: Mapping[str, NDArray[Any]]) -> Arrays:
        """Outputs (B, ...) by name, of raw values (B, ...) and the hidden state by name."""
        outputs = self(*(torch.from_numpy(raw[name]) for name in self.input_names))
        return {name: out.numpy() for name, out in zip(self.output_names, outputs, strict=True)}

    def _output_names(self) -> tuple[str, ...]:
        names = [ACTION]
        names += [] if self.meaning is None else [self.meaning.name]
        names += [] if self.card is None else [EXPECTED_ERRORS, PROBABILITY, SURE]
        names += [NEXT_HIDDEN_STATE] if self.state_size else []
        bounded = self.exploration_std is None or isinstance(self.network, OffPolicyNetwork)
        return (*names, *([] if bounded else [UNBOUNDED_ACTION]))


class _Quantities(nn.Module):
    """Actions (B, A) to the quantities (B, A) that they stand for, and an affine map of those."""

    _low: Tensor
    _per_action: Tensor
    _first: Tensor
    _matrix: Tensor
    _offset: Tensor

    def __init__(
        self,
        meaning: Meaning,
        space: gymnasium.Space[Any],
        correction: Correction | None,
    ):
        super().__init__()
        assert isinstance(space, gymnasium.spaces.Box)
        self.name = meaning.name
        size = len(meaning.quantities)
        matrix, offset = correction or (np.eye(size), np.zeros(size))
        low = np.array([quantity.low for quantity in meaning.quantities])
        high = np.array([quantity.high for quantity in meaning.quantities])
        constants = {
            "_low": low,
            "_per_action": (high - low) / (space.high.astype(np.float64) - space.low),
            "_first": space.low,
            "_matrix": matrix.T,
            "_offset": offset,
        }
        for name, values in constants.items():
            constant = torch.as_tensor(values, dtype=torch.float32)
            self.register_buffer(name, constant, persistent=False)

    def forward(self, actions: Tensor) -> Tensor:
        quantities = self._low + (actions - self._first) * self._per_action
        return quantities @ self._matrix + self._offset


def raw_inputs(space: gymnasium.spaces.Dict, views: Mapping[str, View]) -> dict[str, RawInput]:
    """What the observations of a policy are made of, by name."""
    inputs: dict[str, RawInput] = {}
    for name, part in space.spaces.items():
        box = cast(gymnasium.spaces.Box, part)
        view = views.get(name)
        inputs[name] = (
            raw_input(box) if view is None else raw_input(box, view.sampling, view.unit_per_m)
        )
    return inputs
