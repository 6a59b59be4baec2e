"""What a policy says before images as a camera delivers them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from encoders.raw_inputs import RawInput
from envs.deployment import Meaning
from envs.drawing import annotated
from envs.image_files import read_image
from envs.views import View
from trainers.common.errors import UserError
from trainers.common.files import write_atomically
from trainers.evaluation import find_run
from trainers.inference.confidence import Card
from trainers.inference.fitting import load_raw_policy
from trainers.inference.onnx_policy import OnnxPolicy, is_onnx
from trainers.inference.raw_policy import (
    ACTION,
    EXPECTED_ERRORS,
    HIDDEN_STATE,
    NEXT_HIDDEN_STATE,
    SURE,
    UNBOUNDED_ACTION,
    Arrays,
)
from trainers.inference.real_camera import read_camera

PICTURE = ".png"
INNER_OUTPUTS = (NEXT_HIDDEN_STATE, UNBOUNDED_ACTION)


class RawActingPolicy(Protocol):
    """A policy that takes images as sensors deliver them: `RawPolicy` or `OnnxPolicy`."""

    raw_inputs: dict[str, RawInput]
    views: dict[str, View]
    meaning: Meaning | None
    card: Card | None
    state_size: int

    def run(self, raw: Mapping[str, NDArray[Any]]) -> Arrays:
        """Outputs (1, ...) by name, of raw values (1, ...) and the hidden state by name."""


@dataclass(frozen=True)
class Prediction:
    """What a policy says before one image.

    Attributes:
        file: the image's.
        outputs: (...) by name; the hidden state and the like are left out.
        meaning: of the action.
        card: what `sure` means; None: nobody knows how sure the policy is.
    """

    file: Path
    outputs: Arrays
    meaning: Meaning | None
    card: Card | None

    def plain(self) -> dict[str, Any]:
        """For programs: numbers in the quantities' own units, by their names."""
        plain: dict[str, Any] = {"file": str(self.file)}
        plain |= {name: values.tolist() for name, values in self.outputs.items()}
        if self.meaning is not None:
            names = [quantity.name for quantity in self.meaning.quantities]
            plain[self.meaning.name] = _named(names, self.outputs[self.meaning.name])
        if self.card is not None:
            names = [error.metric for error in self.card.estimated]
            plain[EXPECTED_ERRORS] = _named(names, self.outputs[EXPECTED_ERRORS])
        return plain

    def caption(self) -> str:
        """For people: what the action means, if that is known, and how sure it is, if that is."""
        return "   ".join([*self._shown_action(), *self._shown_confidence()])

    def _shown_action(self) -> list[str]:
        if self.meaning is None:
            return [f"{ACTION} {np.array2string(self.outputs[ACTION], precision=3)}"]
        values = self.outputs[self.meaning.name].tolist()
        parts = zip(self.meaning.quantities, values, strict=True)
        return [quantity.shown(value) for quantity, value in parts]

    def _shown_confidence(self) -> list[str]:
        if self.card is None:
            return []
        expected = zip(self.card.estimated, self.outputs[EXPECTED_ERRORS].tolist(), strict=True)
        errors = ", ".join(error.shown(value) for error, value in expected)
        verdict = "sure" if self.outputs[SURE] else "NOT SURE"
        return [f"{verdict} ({errors} expected)" if errors else verdict]


def _named(names: Sequence[str], values: NDArray[Any]) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))


def predict(options: argparse.Namespace) -> list[Prediction]:
    """Shows a policy some images, each by itself, and draws what it says where that is asked for.

    Args:
        options: as `trainers.predict.parse` returns them.

    Raises:
        UserError: there is no such policy, image or camera, they don't fit each other, or a picture
            can't be written.
    """
    if options.trust:
        find_run(options.policy, (), options.results_dir, trust=True)
    policy = _load(options)
    name = _only_image(policy)
    drawings = _drawings(options.draw, options.images)
    predictions: list[Prediction] = []
    for file, drawing in zip(options.images, drawings, strict=True):
        raw = _read(file, policy.raw_inputs[name])
        state = {HIDDEN_STATE: np.zeros((1, policy.state_size), np.float32)}
        outputs = policy.run({name: raw[None], **state})
        told = {key: values[0] for key, values in outputs.items() if key not in INNER_OUTPUTS}
        predictions.append(Prediction(file, told, policy.meaning, policy.card))
        if drawing is not None:
            _draw(drawing, predictions[-1], policy, name, raw)
    return predictions


def _load(options: argparse.Namespace) -> RawActingPolicy:
    camera = read_camera(options.camera)
    if not is_onnx(options.policy):
        return load_raw_policy(options.policy, options.results_dir, camera, options.unit)
    if camera is not None or options.unit is not None:
        raise UserError(
            f"{options.policy}: has its camera and its unit inside: give --camera and --unit to "
            "`python -m trainers.export POLICY FILE.onnx`, or name the run or the folder here"
        )
    return OnnxPolicy.load(options.policy)


def _only_image(policy: RawActingPolicy) -> str:
    """The name of the only observation.

    Raises:
        UserError: there are others, or it is none of images.
    """
    names = list(policy.raw_inputs)
    if len(names) == 1 and len(policy.raw_inputs[names[0]].shape) > 1:
        return names[0]
    raise UserError(
        f"the policy sees {', '.join(names)}, and images alone can be given here, of one camera: "
        "see docs/python.md for how it is used from Python"
    )


def _read(file: Path, expected: RawInput) -> NDArray[Any]:
    try:
        return read_image(file, expected)
    except ValueError as error:
        raise UserError(str(error)) from error


def _drawings(draw: Path | None, images: Sequence[Path]) -> list[Path | None]:
    """Where to draw each image; None: nowhere."""
    if draw is None:
        return [None] * len(images)
    if draw.suffix == PICTURE:
        if len(images) > 1:
            raise UserError(f"--draw {draw}: one file for several images: name a folder")
        return [draw]
    names = [image.with_suffix(PICTURE).name for image in images]
    if len(set(names)) < len(names):
        raise UserError(f"--draw {draw}: two images have the same name: draw them one by one")
    return [draw / name for name in names]


def _draw(
    path: Path, prediction: Prediction, policy: RawActingPolicy, name: str, raw: NDArray[Any]
) -> None:
    import cv2  # noqa: PLC0415

    meaning = policy.meaning
    is_place = meaning is not None and meaning.is_place
    lines = meaning.lines(prediction.outputs[meaning.name]) if meaning and is_place else []
    try:
        picture = policy.raw_inputs[name].picture(raw)
        drawn = annotated(picture, lines, policy.views.get(name), prediction.caption())
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, cv2.imencode(PICTURE, drawn[..., ::-1])[1].tobytes())
    except ValueError as error:
        raise UserError(f"--draw: {error}") from error
    except OSError as error:
        raise UserError(f"--draw {path}: can't be written: {error.strerror}") from error
