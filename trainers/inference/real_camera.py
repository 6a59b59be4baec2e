"""What commands are told of the real camera: `--camera` and `--unit`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from envs.views import CameraFile


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options."""
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="the real camera's intrinsics and place, where they are not those of training: YAML, "
        "see docs/camera.md",
    )
    parser.add_argument(
        "--unit",
        type=_unit,
        metavar="N",
        help="raw values of N are 1 m (default: the camera file's, or 1000)",
    )


def read_camera(path: Path | None) -> CameraFile | None:
    """Reads a camera file; None where there is none.

    Raises:
        SettingsError: with everything that is wrong, where it stands, and what is allowed.
    """
    if path is None:
        return None
    # Imported late, so that `--help` answers at once.
    from envs.views import CameraFile  # noqa: PLC0415
    from trainers.runfile.validation import InvalidError, validate  # noqa: PLC0415
    from trainers.runfile.yaml_document import Problem, SettingsError, read  # noqa: PLC0415

    document = read(path)
    try:
        return validate(CameraFile, document.data)
    except InvalidError as error:
        raise SettingsError(
            [Problem(document.where(where), where, message) for where, message in error.problems]
        ) from error


def _unit(text: str) -> float:
    """Raises: argparse.ArgumentTypeError: it is none."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"should be a number over 0, not {text!r}")
    return value
