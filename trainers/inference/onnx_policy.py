"""A policy from an ONNX file: run on raw values, or judged as any other policy is."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from envs.deployment import Deployment, Meaning
from envs.views import View
from trainers.common.errors import UserError, first_lines
from trainers.inference.confidence import Card as ConfidenceCard
from trainers.inference.inputs import checked
from trainers.inference.metadata import Metadata
from trainers.inference.raw_policy import (
    ACTION,
    HIDDEN_STATE,
    NEXT_HIDDEN_STATE,
    UNBOUNDED_ACTION,
    Arrays,
    raw_inputs,
)
from trainers.networks.actions import to_environment

SUFFIX = ".onnx"
PACKAGES = ("onnx", "onnxruntime", "onnxscript")


class OnnxPolicy:
    """A policy that `trainers.export` wrote into an ONNX file.

    Args:
        content: of the file.
        origin: what to call it in messages.
        seed: of what `predict` draws when it is not deterministic.

    Attributes:
        observation_space: the observations that acting needs.
        action_space: of one environment.
        raw_inputs: by the name of the observation.
        views: how images are taken, by the same.
        meaning: of its actions; None: nothing but themselves.
        card: what `sure` means; None: nobody knows how sure it is.
        configuration: the run file's text.
        state_size: m, length of the hidden state; 0 without memory.

    Raises:
        UserError: the extra `onnx` is not installed, or the content is of something else.
    """

    def __init__(self, content: bytes, origin: str, seed: int = 0):
        require_onnx()
        self._origin = origin
        self._session = _session(content, origin)
        properties = self._session.get_modelmeta().custom_metadata_map
        if "ventosa" not in properties:
            raise UserError(
                f"{origin}: an ONNX file, and none of ventosa's: expected is one that "
                "`python -m trainers.export POLICY FILE.onnx` wrote"
            )
        try:
            self._read(properties)
        except Exception as error:  # forged, they can be wrong in any way
            raise UserError(
                f"{origin}: of another version of ventosa ({properties['ventosa']}): "
                f"{first_lines(error, 2)}; export the policy anew"
            ) from error
        self._generator = torch.Generator().manual_seed(seed)

    @classmethod
    def load(cls, path: str | Path, seed: int = 0) -> OnnxPolicy:
        """Loads a file.

        Raises:
            UserError: there is none, or see above.
        """
        try:
            return cls(Path(path).read_bytes(), str(path), seed)
        except OSError as error:
            raise UserError(f"{path}: can't be read: {error.strerror}") from error

    def run(self, raw: Mapping[str, NDArray[Any]]) -> Arrays:
        """Outputs (1, ...) by name, of raw values (1, ...) and the hidden state by name."""
        given = {one.name: raw[one.name] for one in self._session.get_inputs()}
        outputs = self._session.run(self._output_names, given)
        return dict(zip(self._output_names, outputs, strict=True))

    def predict(
        self,
        observations: NDArray[Any] | Mapping[str, NDArray[Any]],
        state: NDArray[Any] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], NDArray[np.float32]]:
        """Actions and the next hidden state; see `Policy.predict`, one observation at a time.

        Raises:
            ValueError: see `Policy.predict`.
            UserError: actions are to be drawn, and the file doesn't say how.
        """
        batch, is_single = checked(observations, self.observation_space, self._ignored)
        count = len(next(iter(batch.values())))
        before = np.zeros((count, self.state_size)) if state is None else np.atleast_2d(state)
        rows = [self._act(batch, before, slice(row, row + 1)) for row in range(count)]
        if deterministic:
            actions = np.concatenate([row[ACTION] for row in rows])
        else:
            actions = self._drawn(rows)
        after = np.concatenate([row.get(NEXT_HIDDEN_STATE, before[:1]) for row in rows])
        next_state = after.astype(np.float32)
        return (actions[0], next_state[0]) if is_single else (actions, next_state)

    def _act(self, batch: Arrays, before: NDArray[Any], row: slice) -> Arrays:
        raw = {name: part.spread(batch[name][row]) for name, part in self.raw_inputs.items()}
        return self.run({**raw, HIDDEN_STATE: before[row].astype(np.float32)})

    def _drawn(self, rows: Sequence[Arrays]) -> NDArray[Any]:
        """Actions as at the end of training."""
        if self._exploration_std is None:
            raise UserError(
                f"{self._origin}: how its actions were drawn in training is not in the file, and "
                "whole episodes are judged with that: evaluate the run or the folder"
            )
        best = torch.from_numpy(
            np.concatenate([row.get(UNBOUNDED_ACTION, row[ACTION]) for row in rows])
        )
        noise = torch.randn(best.shape, generator=self._generator)
        return to_environment(best + noise * self._exploration_std, self.action_space)

    def _read(self, properties: Mapping[str, str]) -> None:
        metadata = Metadata.from_json(properties["policy"])
        inputs, views, std = (
            json.loads(properties[name]) for name in ("inputs", "views", "exploration_std")
        )
        space = metadata.observation_space
        self.observation_space = gymnasium.spaces.Dict([(name, space[name]) for name in inputs])
        self._ignored = space.spaces.keys() - inputs.keys()
        self.action_space = metadata.action_space
        deployment = metadata.deployment or Deployment()
        self.meaning: Meaning | None = deployment.meaning
        card = properties.get("confidence", "null")
        self.card = None if card == "null" else ConfidenceCard.model_validate_json(card)
        self.views = {name: View.model_validate(view) for name, view in views.items()}
        self.raw_inputs = raw_inputs(self.observation_space, self.views)
        self.configuration = properties["configuration"]
        self._exploration_std = None if std is None else torch.tensor(std)
        self._output_names = [one.name for one in self._session.get_outputs()]
        sizes = {one.name: one.shape[1] for one in self._session.get_inputs()}
        self.state_size: int = sizes.get(HIDDEN_STATE, 0)


def is_onnx(policy: str | Path) -> bool:
    """Whether a policy's name is that of an ONNX file."""
    return Path(policy).suffix == SUFFIX


def require_onnx() -> None:
    """Refuses to go on without the packages.

    Raises:
        UserError: one is missing.
    """
    if missing := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
        raise UserError(
            f"ONNX files need {missing[0]}, which is not installed: install ventosa with its extra "
            "`onnx`, pip install -e '.[onnx]'"
        )


def _session(content: bytes, origin: str) -> Any:
    """One thread: these networks are small, and others may run beside them."""
    import onnxruntime  # noqa: PLC0415

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no base of their own
        raise UserError(f"{origin}: no ONNX file: {first_lines(error, 1)}") from error
