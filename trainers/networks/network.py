"""Encoders, a trunk and perhaps memory: from observations to a hidden vector."""

from __future__ import annotations

from collections.abc import Callable, ItemsView, Iterator, KeysView, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Literal, Protocol, cast, runtime_checkable

import gymnasium
import torch
from pydantic import BaseModel, Field
from torch import Tensor, nn

from trainers.networks.observations import Observations, is_frame
from trainers.networks.recurrent import MemorySettings, Recurrent, Sequences

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "silu": nn.SiLU,
    "elu": nn.ELU,
}


class NetworkSettings(BaseModel, frozen=True, extra="forbid"):
    """The part of a network after its encoders."""

    hidden_units: int = Field(256, ge=1, le=4096, description="Units of each hidden layer.")
    num_layers: int = Field(2, ge=0, le=100, description="Hidden layers after the encoders.")
    activation: Literal["relu", "tanh", "silu", "elu"] = Field(
        "relu", description="Activation of the hidden layers."
    )
    precision: Literal["float32", "bfloat16"] = Field(
        "float32",
        description="Numbers that encoders and hidden layers calculate with; bfloat16 is faster "
        "where the processor knows it. Weights, memory, heads and losses are always float32.",
    )
    normalize: bool = Field(
        False, description="Standardise vector observations whose encoder is not set otherwise."
    )


@runtime_checkable
class Standardizing(Protocol):
    """An encoder that standardises by what it has seen."""

    def update_statistics(self, batch: Tensor) -> None:
        """Shows it raw vectors (B, n)."""


class EncoderDict(nn.ModuleDict):
    """Encoders by their observations' names, whatever these are.

    Where torch refuses a name for a module, because of its dots or because its classes have an
    attribute of that name (`type`, `values`), the module's is `=` and the name with dots as `%2E`.
    """

    def __getitem__(self, name: str) -> nn.Module:
        return super().__getitem__(_module_name(name))

    def __setitem__(self, name: str, encoder: nn.Module) -> None:
        super().__setitem__(_module_name(name), encoder)

    def __contains__(self, name: str) -> bool:
        return super().__contains__(_module_name(name))

    def __iter__(self) -> Iterator[str]:
        return map(_observation_name, super().__iter__())

    def keys(self) -> KeysView[str]:
        """Names of the observations."""
        return dict(self.items()).keys()

    def items(self) -> ItemsView[str, nn.Module]:
        """Names of the observations, and their encoders."""
        return dict(zip(self, self.values(), strict=True)).items()


def _module_name(observation: str) -> str:
    refused = "." in observation or hasattr(nn.ModuleDict(), observation)
    if observation and not refused and not observation.startswith("="):
        return observation
    return "=" + observation.replace("%", "%25").replace(".", "%2E")


def _observation_name(module: str) -> str:
    if not module.startswith("="):
        return module
    return module[1:].replace("%2E", ".").replace("%25", "%")


class Network(nn.Module):
    """Encodes observations, passes them through a trunk of dense layers, and perhaps a memory.

    Args:
        encoders: by the name of the observation; frames and vectors are told apart by `spaces`.
        spaces: of the same names.
        settings: the trunk.
        memory: what follows the trunk, if anything.

    Attributes:
        features_dim: length of the hidden vector.
        state_size: m, length of the hidden state; 0 without memory.
    """

    def __init__(
        self,
        encoders: Mapping[str, nn.Module],
        spaces: Mapping[str, gymnasium.Space[Any]],
        settings: NetworkSettings,
        memory: MemorySettings | None = None,
    ):
        super().__init__()
        self.frame_encoders = EncoderDict(
            {k: e for k, e in encoders.items() if is_frame(spaces[k])}
        )
        self.vector_encoders = EncoderDict(
            {k: e for k, e in encoders.items() if not is_frame(spaces[k])}
        )
        width = sum(cast(int, encoder.features_dim) for encoder in encoders.values())
        self.trunk, width = hidden_layers(width, settings)
        self._settings = settings
        self.memory = None if memory is None else Recurrent(width, memory)
        self.features_dim = width if self.memory is None else self.memory.features_dim
        self.state_size = 0 if self.memory is None else self.memory.state_size

    def encode_frames(self, frames: Mapping[str, Tensor]) -> Tensor | None:
        """Features (U, f) of U frames by name; None for a network without images.

        Without vectors that is the whole network but its memory, so that experience which shares a
        frame shares all of its cost.
        """
        if not self.frame_encoders:
            return None
        with precision(self._settings, next(iter(frames.values())).device):
            parts = [encoder(frames[name]) for name, encoder in self.frame_encoders.items()]
            features = _joined(parts)
            return (features if self.vector_encoders else self.trunk(features)).float()

    def forward(self, observations: Observations, frame_features: Tensor | None = None) -> Tensor:
        """Hidden vectors (B, features_dim) alone; see `forward_recurrent`."""
        return self.forward_recurrent(observations, frame_features)[0]

    def forward_recurrent(
        self, observations: Observations, frame_features: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Hidden vectors, and the hidden states after them.

        Args:
            observations: B observations.
            frame_features: (B, f) of their frames, from `encode_frames`, where they are known.

        Returns:
            (B, features_dim), and the hidden states (S, m) after the last of each sequence; (B, 0)
            without memory.
        """
        hidden = self._feed_forward(observations, frame_features)
        if self.memory is None:
            return hidden, hidden.new_empty(len(hidden), 0)
        sequences = observations.sequences
        if sequences is None:
            sequences = Sequences.single(hidden.new_zeros(len(hidden), self.state_size))
        outputs: tuple[Tensor, Tensor] = self.memory(hidden, sequences)
        return outputs

    def _feed_forward(self, observations: Observations, frame_features: Tensor | None) -> Tensor:
        """Outputs of the trunk (B, ...) for each observation by itself."""
        if frame_features is None:
            frame_features = self.encode_frames(observations.frames)
            if frame_features is not None and observations.frame_index is not None:
                frame_features = frame_features[observations.frame_index]
        parts = [] if frame_features is None else [frame_features]
        if not self.vector_encoders:
            return parts[0]
        vectors = observations.vectors
        with precision(self._settings, next(iter(vectors.values())).device):
            parts += [encoder(vectors[name]) for name, encoder in self.vector_encoders.items()]
            return self.trunk(_joined(parts)).float()

    def update_statistics(self, vectors: Mapping[str, Tensor]) -> None:
        """Shows vectors (B, n) to the encoders that standardise."""
        for name, encoder in self.vector_encoders.items():
            if name in vectors and isinstance(encoder, Standardizing):
                encoder.update_statistics(vectors[name])


@contextmanager
def evaluation_mode(network: nn.Module) -> Iterator[None]:
    """Evaluation mode for a network; afterwards each of its modules is in its own mode again."""
    training = [module for module in network.modules() if module.training]
    network.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Features side by side."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts), dim=1)


def _orthogonal(layer: nn.Linear, gain: float) -> nn.Linear:
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def precision(settings: NetworkSettings, device: torch.device) -> AbstractContextManager[None]:
    """Context where encoders and hidden layers calculate as the settings say."""
    # Entering autocast costs time even where it is not enabled.
    lowered = settings.precision == "bfloat16"
    return torch.autocast(device.type, torch.bfloat16) if lowered else nullcontext()


def hidden_layers(inputs: int, settings: NetworkSettings) -> tuple[nn.Sequential, int]:
    """The dense layers that follow the encoders, and how many numbers come out of them."""
    layers: list[nn.Module] = []
    width = inputs
    for _ in range(settings.num_layers):
        layers += [_orthogonal(nn.Linear(width, settings.hidden_units), gain=2**0.5)]
        layers += [ACTIVATIONS[settings.activation]()]
        width = settings.hidden_units
    return nn.Sequential(*layers), width


def head(inputs: int, outputs: int, gain: float) -> nn.Linear:
    """A last layer with small, orthogonal weights."""
    return _orthogonal(nn.Linear(inputs, outputs), gain)


class Dense(nn.Sequential):
    """Hidden layers in the precision of the settings, and a last one in float32.

    Args:
        inputs: length of the features.
        outputs: length of what comes out.
        gain: of the last layer's weights; see `head`.
        settings: the hidden layers.
    """

    def __init__(self, inputs: int, outputs: int, gain: float, settings: NetworkSettings):
        hidden, width = hidden_layers(inputs, settings)
        super().__init__(*hidden, head(width, outputs, gain))
        self._settings = settings

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs) -> (B, outputs) float32."""
        *hidden, last = self
        with precision(self._settings, features.device):
            for layer in hidden:
                features = layer(features)
        outputs: Tensor = last(features.float())
        return outputs
