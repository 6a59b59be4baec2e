"""Memory of earlier observations: a recurrent layer, and the sequences it runs through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence


class MemorySettings(BaseModel, frozen=True, extra="forbid"):
    """A recurrent layer after the hidden layers."""

    type: Literal["lstm", "gru"] = Field("lstm", description="Kind of the recurrent layer.")
    memory_size: int = Field(128, ge=1, le=4096, description="Units of the recurrent layer.")
    sequence_length: int = Field(
        64,
        ge=1,
        description="Steps through which gradients flow back, at most; the end of an episode, of "
        "a batch and of a collection (buffer_size / num_envs steps) end a sequence, too.",
    )


@dataclass(frozen=True)
class Sequences:
    """S runs of observations, each in the order of time, which stand one after the other.

    Attributes:
        lengths: (S,) int64 on the CPU; they add up to the number of observations.
        hidden_state: (S, m) before the first observation of each; zeros where an episode begins.
    """

    lengths: Tensor
    hidden_state: Tensor

    @classmethod
    def single(cls, hidden_state: Tensor) -> Sequences:
        """One observation for each row of a hidden state (B, m)."""
        return cls(torch.ones(len(hidden_state), dtype=torch.int64), hidden_state)


class Recurrent(nn.Module):
    """An LSTM (Hochreiter and Schmidhuber 1997) or a GRU (Cho et al. 2014).

    Args:
        inputs: length of the vectors it is given.
        settings: the layer.

    Attributes:
        features_dim: length of the vectors it returns.
        state_size: m, length of the hidden state; an LSTM's holds its cell state, too.
    """

    def __init__(self, inputs: int, settings: MemorySettings):
        super().__init__()
        self.features_dim = settings.memory_size
        self._parts = 2 if settings.type == "lstm" else 1
        self.state_size = self._parts * settings.memory_size
        layer = nn.LSTM if settings.type == "lstm" else nn.GRU
        self.layer: nn.RNNBase = layer(inputs, settings.memory_size)
        for name, parameter in self.layer.named_parameters():
            (nn.init.orthogonal_ if name.startswith("weight") else nn.init.zeros_)(parameter)

    def forward(self, vectors: Tensor, sequences: Sequences) -> tuple[Tensor, Tensor]:
        """Runs through the sequences.

        Args:
            vectors: (B, inputs).
            sequences: S of them, of B steps together.

        Returns:
            Outputs of all steps (B, features_dim), and the hidden states (S, m) after the last
            ones.
        """
        before = self._layer_state(sequences.hidden_state)
        if len(sequences.lengths) == len(vectors):  # each by itself, as whoever acts has them
            outputs, after = self.layer(vectors[None], before)
            return outputs[0], self._hidden_state(after)
        rows, counts, order = _in_step(sequences.lengths)
        rows, order = rows.to(vectors.device), order.to(vectors.device)
        packed = PackedSequence(vectors[rows], counts, order, order.argsort())
        packed_outputs, after = self.layer(packed, before)
        return packed_outputs.data[rows.argsort()], self._hidden_state(after)

    def _layer_state(self, hidden_state: Tensor) -> Any:
        """A hidden state (S, m) as torch's layer takes it."""
        parts = tuple(part.contiguous() for part in hidden_state[None].chunk(self._parts, dim=-1))
        return parts if self._parts > 1 else parts[0]

    def _hidden_state(self, after: Any) -> Tensor:
        """The inverse of `_layer_state`."""
        whole: Tensor = torch.cat(after, dim=-1) if self._parts > 1 else after
        return whole[0]


def number_sequences(done: NDArray[np.bool_], length: int) -> NDArray[np.int64]:
    """Divides T steps of N environments into sequences, none of which reaches beyond an episode.

    Args:
        done: (T, N) the episode ended with this step.
        length: steps of a sequence, at most.

    Returns:
        (T, N) the number of each step's sequence; numbers begin with 0 and leave none out.
    """
    begins = np.vstack([np.ones_like(done[:1]), done[:-1]])
    age = np.arange(len(done))[:, None] - _latest(begins)
    first = age % length == 0
    numbers = np.cumsum(first).reshape(first.shape) - 1
    return np.take_along_axis(numbers, _latest(first), axis=0)


def _latest(events: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Times (T, N) of the latest event up to each time; each column begins with one."""
    time = np.arange(len(events))[:, None]
    return np.maximum.accumulate(np.where(events, time, 0))


def _in_step(lengths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sequences side by side in the form of a `PackedSequence`, without padding on the way there.

    Args:
        lengths: (S,) of sequences that stand one after the other, B steps together.

    Returns:
        The rows (B,) of all first steps, then of all second steps and so forth; how many there are
        of each (longest length,); and the order of the sequences (S,), the longest first.
    """
    starts = lengths.cumsum(0) - lengths
    lengths, order = lengths.sort(descending=True, stable=True)
    time = torch.arange(int(lengths[0]))[:, None]
    under_way = time < lengths
    return (starts[order] + time)[under_way], under_way.sum(1), order
