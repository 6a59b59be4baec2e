"""Work that is the same each time, repeated by an accelerator without being told each kernel."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

WARM_UP = 3
"""Calls before the capture, in which libraries and optimizers take the memory they keep."""

Work = Callable[[Tensor], dict[str, Tensor]]


class Captured:
    """A function whose kernels a CUDA graph repeats; on other devices the function itself.

    An optimizer step is hundreds of kernels, each of which takes longer to launch than to run.
    The first calls are plain ones; then the kernels are captured (PyTorch's notes, "CUDA Graphs"),
    and from then on repeated on the same memory. So the function must do the same with all numbers
    (no shape, and no branch on the CPU, may depend on one), read what changes from its argument or
    from tensors that are changed in place, and read nothing back.

    Args:
        function: of a tensor that always has the same shape; to numbers by name.
        generator: what it draws from.
        device: where it works.
    """

    def __init__(self, function: Work, generator: torch.Generator, device: torch.device):
        self._function, self._generator, self._device = function, generator, device
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._argument = torch.empty(0)
        self._results: dict[str, Tensor] = {}

    def __call__(self, argument: Tensor) -> dict[str, Tensor]:
        """What the function says of an argument, which is its own to keep."""
        self._calls += 1
        if self._device.type != "cuda":
            return self._function(argument)
        if self._calls <= WARM_UP:
            return self._warm_up(argument)
        if self._graph is None:
            self._graph = self._capture(argument)
        self._argument.copy_(argument)
        self._graph.replay()
        return {name: value.clone() for name, value in self._results.items()}

    def _warm_up(self, argument: Tensor) -> dict[str, Tensor]:
        """A plain call, on a stream of its own as captures are."""
        stream = torch.cuda.Stream(self._device)
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            results = self._function(argument)
        torch.cuda.current_stream(self._device).wait_stream(stream)
        return results

    def _capture(self, argument: Tensor) -> torch.cuda.CUDAGraph:
        """The function's kernels, none of which runs yet."""
        self._argument = argument.clone()
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._generator)
        with torch.cuda.graph(graph):
            self._results = self._function(self._argument)
        return graph
