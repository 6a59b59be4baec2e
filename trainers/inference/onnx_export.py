"""A policy as one ONNX file: what sensors deliver goes in, what its actions mean comes out."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from encoders.saved_spaces import space_to_plain
from trainers.common.errors import UserError, first_lines
from trainers.inference.onnx_policy import require_onnx
from trainers.inference.raw_policy import (
    ACTION,
    EXPECTED_ERRORS,
    HIDDEN_STATE,
    NEXT_HIDDEN_STATE,
    PROBABILITY,
    SURE,
    Arrays,
    RawPolicy,
)


@dataclass(frozen=True)
class Card:
    """What the file says beside what can be worked out from the policy.

    Attributes:
        metadata: content of the policy's `policy.json`.
        configuration: the run file's text.
        weights_sha256: of the file of weights that were exported.
    """

    metadata: str
    configuration: str
    weights_sha256: str


def to_onnx(policy: RawPolicy, card: Card) -> bytes:
    """The content of an ONNX file, for batches of one.

    Raises:
        UserError: the extra `onnx` is not installed, or torch can't translate the network.
    """
    require_onnx()
    import onnx  # noqa: PLC0415

    values = [torch.from_numpy(value) for value in _zeros(policy).values()]
    try:
        with torch.no_grad(), _quiet():
            program = torch.onnx.export(
                policy.eval(),
                tuple(values),
                dynamo=True,
                verbose=False,
                input_names=list(policy.input_names),
                output_names=list(policy.output_names),
            )
    except Exception as error:  # whatever its steps stumble over
        raise UserError(
            f"the policy's network can't be exported to ONNX: {first_lines(error, 3)}"
        ) from error
    assert program is not None
    model = program.model_proto
    onnx.helper.set_model_props(model, _properties(policy, card))
    content: bytes = model.SerializeToString()
    return content


def _zeros(policy: RawPolicy) -> Arrays:
    """Inputs of one observation, all 0, by name."""
    inputs: Arrays = {
        name: np.zeros((1, *raw.shape), raw.dtype) for name, raw in policy.raw_inputs.items()
    }
    if policy.state_size:
        inputs[HIDDEN_STATE] = np.zeros((1, policy.state_size), np.float32)
    return inputs


def _properties(policy: RawPolicy, card: Card) -> dict[str, str]:
    """What is stored in the file, as text."""
    outputs: dict[str, Any] = {ACTION: space_to_plain(policy.action_space)}
    if policy.meaning is not None:
        outputs[policy.meaning.name] = policy.meaning.model_dump(mode="json")
    if policy.state_size:
        outputs[NEXT_HIDDEN_STATE] = {"size": policy.state_size}
    if policy.card is not None:
        names = [error.metric for error in policy.card.estimated]
        outputs |= {EXPECTED_ERRORS: names, PROBABILITY: "of being right", SURE: "bool"}
    std = policy.exploration_std
    plain = {
        "inputs": {name: raw.about() for name, raw in policy.raw_inputs.items()},
        "outputs": outputs,
        "views": {name: view.model_dump(mode="json") for name, view in policy.views.items()},
        "exploration_std": None if std is None else std.tolist(),
        "confidence": None if policy.card is None else policy.card.model_dump(mode="json"),
    }
    return {
        "ventosa": importlib.metadata.version("ventosa"),
        "torch": torch.__version__,
        "policy": card.metadata,
        "configuration": card.configuration,
        "weights_sha256": card.weights_sha256,
        **{name: json.dumps(value) for name, value in plain.items()},
    }


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps torch's exporter from telling what it does, and what it could do with more packages."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
