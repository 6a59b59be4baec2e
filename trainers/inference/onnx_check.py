"""What is seen to before an exported file is let out of the house: it says what torch says."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from trainers.common.errors import UserError
from trainers.inference.raw_policy import ACTION, HIDDEN_STATE, SURE, Arrays, RawPolicy

LARGEST_DIFFERENCE = 1e-4
"""Between torch and the file: of a range, or of a number over 1; of choices none."""
LARGEST_ON_NOISE = 1e-3
"""The same before images of noise, where nothing is attended to and rounding counts for more."""


def drawn_inputs(policy: RawPolicy, rng: np.random.Generator) -> Arrays:
    """Inputs of one observation, drawn from all there can be."""
    inputs: Arrays = {}
    for name, raw in policy.raw_inputs.items():
        if np.issubdtype(raw.dtype, np.integer):
            # Of all sizes: most uint16 are beyond the range of any image.
            top = int(2.0 ** rng.uniform(1.0, np.log2(np.iinfo(raw.dtype).max)))
            inputs[name] = rng.integers(0, top, (1, *raw.shape), raw.dtype)
        else:
            inputs[name] = rng.standard_normal((1, *raw.shape)).astype(raw.dtype)
    if policy.state_size:
        inputs[HIDDEN_STATE] = rng.uniform(-1, 1, (1, policy.state_size)).astype(np.float32)
    return inputs


class Runnable(Protocol):
    """What can be held against a policy in torch."""

    def run(self, raw: Mapping[str, NDArray[Any]]) -> Arrays:
        """Outputs (1, ...) by name, of inputs (1, ...) by name."""


def differences(
    policy: RawPolicy,
    other: Runnable,
    observations: Sequence[Mapping[str, NDArray[Any]]],
    tolerance: float | None = None,
) -> Arrays:
    """The largest differences between a policy and another, (...) by the outputs' names.

    Args:
        policy: in torch.
        other: the same, in another form.
        observations: what both are shown, one after the other.
        tolerance: see `LARGEST_DIFFERENCE`; None: any will do.

    Raises:
        UserError: they differ by more.
    """
    largest: Arrays = {}
    for inputs in observations:
        found = other.run(inputs)
        for name, values in policy.run(inputs).items():
            if name == SURE:  # follows from the others, and may be on the edge
                continue
            off = np.abs(found[name].astype(np.float64) - values)[0]
            largest[name] = np.maximum(largest.get(name, 0.0), off)
            fits = tolerance is None or off <= tolerance * _scale(policy, name, values[0])
            if not np.all(fits):
                raise UserError(
                    f"the export is of no use, please report it: {name} is "
                    f"{found[name][0].tolist()}, where torch says {values[0].tolist()}"
                )
    return largest


def _scale(policy: RawPolicy, name: str, values: NDArray[Any]) -> NDArray[Any]:
    """What differences of an output (...) are measured by."""
    if policy.meaning is not None and name == policy.meaning.name:
        return np.array([abs(one.high - one.low) for one in policy.meaning.quantities])
    if name == ACTION:
        match policy.action_space:
            case gymnasium.spaces.Discrete() | gymnasium.spaces.MultiDiscrete():
                return np.zeros(())  # another choice is no small difference
            case gymnasium.spaces.MultiBinary():
                return np.zeros(())
            case gymnasium.spaces.Box() as box if box.is_bounded():
                return box.high - box.low
    return np.maximum(np.abs(values), 1.0)


def median_ms(policy: Runnable, inputs: Sequence[Arrays]) -> float:
    """Milliseconds that one observation takes."""
    times_s = []
    for values in inputs:
        begun_s = time.perf_counter()
        policy.run(values)
        times_s.append(time.perf_counter() - begun_s)
    return 1000.0 * float(np.median(times_s))


def reported(what: str, policy: RawPolicy, off: Arrays) -> str:
    """Largest differences as people read them."""
    shown = {name: f"{np.max(values, initial=0.0):.1e}" for name, values in off.items()}
    if policy.meaning is not None:
        parts = zip(policy.meaning.quantities, off[policy.meaning.name], strict=True)
        shown[policy.meaning.name] = ", ".join(part.shown(value, ".5f") for part, value in parts)
    return f"largest difference {what}: " + "; ".join(f"{k} {text}" for k, text in shown.items())
