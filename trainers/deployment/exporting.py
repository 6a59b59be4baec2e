"""Export of a policy: to a folder of its own, or to one ONNX file."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from envs.environment import EnvironmentFailure
from trainers.common.errors import UserError, first_lines
from trainers.common.files import write_atomically
from trainers.evaluation import FIRST_SEED, evaluation_environment, find_run
from trainers.inference.confidence import FILE as CONFIDENCE
from trainers.inference.confidence import read_confidence, to_bytes, weights_digest
from trainers.inference.fitting import load_raw_policy
from trainers.inference.metadata import FILE as METADATA
from trainers.inference.onnx_check import (
    LARGEST_DIFFERENCE,
    LARGEST_ON_NOISE,
    differences,
    drawn_inputs,
    median_ms,
    reported,
)
from trainers.inference.onnx_export import Card, to_onnx
from trainers.inference.onnx_policy import OnnxPolicy, is_onnx
from trainers.inference.policy import complete_metadata
from trainers.inference.raw_policy import Arrays, RawPolicy
from trainers.inference.real_camera import read_camera
from trainers.saving.checkpoint import MANIFEST, WEIGHTS, Loaded, weights_manifest
from trainers.saving.run_folder import CHECKPOINTS, CONFIGURATION, find_checkpoint, run_folder

ONNX_FILE = "policy.onnx"
CHECKED = 100
"""Observations that a file is checked on."""


def export(policy: str, folder: Path, results_dir: Path, *, force: bool = False) -> list[str]:
    """Writes a policy's weights, with their checksum, its run file and its spaces.

    With them goes how sure it is, where that was learned; nothing of the training state does.

    Args:
        policy: a run's folder or id, or a checkpoint's folder.
        folder: of the exported policy; made where it is missing.
        results_dir: where a run is looked for by its id.
        force: replace a policy that is there.

    Returns:
        The files' names.

    Raises:
        UserError: there is no such policy, one is in the folder already, or it can't be written.
    """
    checkpoint = find_checkpoint(policy, results_dir)
    source = run_folder(checkpoint.path)
    weights = _weights(checkpoint)
    contents: dict[str, bytes | str] = {
        WEIGHTS: weights,
        CONFIGURATION: (source / CONFIGURATION).read_bytes(),
        METADATA: complete_metadata(source).to_json(),
    }
    if (confidence := read_confidence(checkpoint.path)) is not None:
        contents[CONFIDENCE] = to_bytes(confidence)
    # Last: one of before does not fit the new weights, and what was cut off is refused by it.
    contents[MANIFEST] = weights_manifest(checkpoint, weights)
    if (folder / CHECKPOINTS).is_dir():
        raise UserError(f"{folder}: this is a run: choose another folder")
    _write(folder, contents, force)
    if CONFIDENCE not in contents:
        (folder / CONFIDENCE).unlink(missing_ok=True)  # of the policy that was replaced
    return list(contents)


def _weights(checkpoint: Loaded) -> bytes:
    try:
        return (checkpoint.path / WEIGHTS).read_bytes()
    except FileNotFoundError as error:
        raise UserError(
            f"{checkpoint.path}: its run has removed it meanwhile: export once more"
        ) from error


def export_onnx(options: argparse.Namespace) -> list[str]:
    """Writes a policy into one ONNX file, once it was seen to say what torch says.

    Args:
        options: as `trainers.export.parse` returns them.

    Returns:
        What to tell of it, a line each.

    Raises:
        UserError: there is no such policy, it can't be exported or differs, or a file is there
            already or can't be written.
    """
    path = options.folder if is_onnx(options.folder) else options.folder / ONNX_FILE
    _check_free(path.parent, [path.name], options.force)
    camera = read_camera(options.camera)
    fitted = (options.results_dir, camera, options.unit)
    policy = load_raw_policy(options.policy, *fitted)
    checkpoint = find_checkpoint(options.policy, options.results_dir)
    content = to_onnx(policy, _card(checkpoint))
    exported = OnnxPolicy(content, str(path))
    drawn = _drawn_inputs(policy)
    seen, reason = _seen_inputs(policy, drawn, options)
    report = [
        f"{path}: {', '.join(policy.input_names)} -> {', '.join(policy.output_names)}",
        *_checked(policy, exported, seen, drawn[len(seen) :], reason),
    ]
    trained = load_raw_policy(options.policy, *fitted, full_precision=False)
    off = differences(policy, trained, seen or drawn)
    if any(values.any() for values in off.values()):
        report.append(reported("to torch in bfloat16, as it was trained", policy, off))
    _write(path.parent, {path.name: content}, options.force)
    return [*report, f"{median_ms(exported, drawn):.2f} ms an observation, on one thread (median)"]


def _checked(
    policy: RawPolicy,
    exported: OnnxPolicy,
    seen: Sequence[Arrays],
    drawn: Sequence[Arrays],
    reason: str,
) -> Iterator[str]:
    """How far the file is from torch, if that is near enough."""
    for what, inputs, tolerance in (
        ("of its environment", seen, LARGEST_DIFFERENCE),
        (f"drawn at random{reason}", drawn, LARGEST_ON_NOISE),
    ):
        if inputs:
            off = differences(policy, exported, inputs, tolerance)
            yield reported(f"to torch, on {len(inputs)} observations {what}", policy, off)


def _card(checkpoint: Loaded) -> Card:
    source = run_folder(checkpoint.path)
    return Card(
        metadata=complete_metadata(source).to_json(),
        configuration=(source / CONFIGURATION).read_text(),
        weights_sha256=weights_digest(checkpoint.path),
    )


def _drawn_inputs(policy: RawPolicy) -> list[Arrays]:
    rng = np.random.default_rng(0)
    return [drawn_inputs(policy, rng) for _ in range(CHECKED)]


def _seen_inputs(
    policy: RawPolicy, drawn: Sequence[Arrays], options: argparse.Namespace
) -> tuple[list[Arrays], str]:
    """Half of the inputs, with what the environment shows; and why there are none, otherwise."""
    half = CHECKED // 2
    try:
        _, run = find_run(options.policy, (), options.results_dir)
        with closing(evaluation_environment(run, half)) as env:
            shown, _ = env.reset(seed=FIRST_SEED)
            count = min(env.num_envs, half)
    except (UserError, EnvironmentFailure) as error:
        return [], f" ({first_lines(error, 1)})"
    return [
        values | {k: raw.spread(shown[k][row : row + 1]) for k, raw in policy.raw_inputs.items()}
        for row, values in enumerate(drawn[:count])
    ], ""


def _write(folder: Path, contents: Mapping[str, bytes | str], force: bool) -> None:
    _check_free(folder, contents, force)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            write_atomically(folder / name, content)
    except OSError as error:
        raise UserError(f"{folder}: can't be written: {error.strerror}") from error


def _check_free(folder: Path, names: Iterable[str], force: bool) -> None:
    if not force and (taken := [name for name in names if (folder / name).exists()]):
        raise UserError(
            f"{folder}: {', '.join(taken)} would be replaced: choose another folder, or --force"
        )
