"""Memory of what was observed before: a recurrent layer, and the sequences it runs through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import BaseModel, Field
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_sequence, unpack_sequence


class MemorySettings(BaseModel, frozen=True, extra="forbid"):
    """A recurrent layer after the hidden layers."""

    type: Literal["lstm", "gru"] = Field("lstm", description="Kind of the recurrent layer.")
    memory_size: int = Field(128, ge=1, description="Units of the recurrent layer.")
    sequence_length: int = Field(
        64, ge=1, description="Steps through which gradients flow back, at most."
    )


@dataclass(frozen=True)
class Sequences:
    """S runs of observations, each in the order of time, which stand one after the other.

    Attributes:
        lengths: (S,) int64 on the CPU; they add up to the number of observations.
        state: (S, m) what is remembered before the first observation of each; zeros where an
            episode begins.
    """

    lengths: Tensor
    state: Tensor

    @classmethod
    def single(cls, state: Tensor) -> Sequences:
        """One observation for each row of a state (B, m)."""
        return cls(torch.ones(len(state), dtype=torch.int64), state)


class Recurrent(nn.Module):
    """An LSTM (Hochreiter and Schmidhuber 1997) or a GRU (Cho et al. 2014).

    Args:
        inputs: length of the vectors it is given.
        settings: the layer.

    Attributes:
        features_dim: length of the vectors it returns.
        state_size: m, the numbers that it remembers; of an LSTM hidden and cell state.
    """

    def __init__(self, inputs: int, settings: MemorySettings):
        super().__init__()
        self.features_dim = settings.memory_size
        self._parts = 2 if settings.type == "lstm" else 1
        self.state_size = self._parts * settings.memory_size
        layer = nn.LSTM if settings.type == "lstm" else nn.GRU
        self.layer: nn.RNNBase = layer(inputs, settings.memory_size, batch_first=True)
        for name, parameter in self.layer.named_parameters():
            (nn.init.orthogonal_ if name.startswith("weight") else nn.init.zeros_)(parameter)

    def forward(self, vectors: Tensor, sequences: Sequences) -> tuple[Tensor, Tensor]:
        """Runs through the sequences.

        Args:
            vectors: (B, inputs).
            sequences: S of them, of B steps together.

        Returns:
            What comes out at each step, (B, features_dim), and the states (S, m) after the last
            steps.
        """
        parts = [part.contiguous() for part in sequences.state[None].chunk(self._parts, dim=-1)]
        packed = pack_sequence(vectors.split(sequences.lengths.tolist()), enforce_sorted=False)
        outputs, last = self.layer(packed, tuple(parts) if self._parts == 2 else parts[0])
        state = torch.cat(last, dim=-1) if isinstance(last, tuple) else last
        return torch.cat(unpack_sequence(outputs)), state[0]
