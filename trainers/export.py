"""The command line: `python -m trainers.export results/run policies/mine`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from trainers.common.errors import UserError
from trainers.common.files import write_atomically
from trainers.inference.metadata import FILE as METADATA
from trainers.inference.policy import find_metadata
from trainers.learn import DONE, MISTAKE
from trainers.saving.checkpoint import MANIFEST, WEIGHTS, weights_manifest
from trainers.saving.run_folder import CHECKPOINTS, CONFIGURATION, find_checkpoint, run_folder


def main(arguments: Sequence[str] | None = None) -> int:
    """Exports a policy; returns the exit code."""
    options = parse(arguments)
    try:
        export(options.policy, options.folder, options.results_dir, force=options.force)
    except UserError as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        return MISTAKE
    print(f"{options.folder}: {', '.join((WEIGHTS, MANIFEST, CONFIGURATION, METADATA))}")
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m trainers.export",
        description="Write what it takes to use a policy into a folder of its own.",
    )
    parser.add_argument("policy", help="a run (its best checkpoint) or a checkpoint's folder")
    parser.add_argument("folder", type=Path, help="where to; `trainers.evaluate FOLDER` takes it")
    parser.add_argument("--force", action="store_true", help="replace a policy that is there")
    parser.add_argument(
        "--results-dir", type=Path, default=Path("results"), help="where runs are kept"
    )
    return parser.parse_args(arguments)


def export(policy: str, folder: Path, results_dir: Path, *, force: bool = False) -> None:
    """Writes a policy's weights, with their checksum, its run file and its spaces.

    Nothing of the training state is among them.

    Args:
        policy: a run's folder or id, or a checkpoint's folder.
        folder: of the exported policy; made where it is missing.
        results_dir: where a run is looked for by its id.
        force: replace a policy that is there.

    Raises:
        UserError: there is no such policy, one is in the folder already, or it can't be written.
    """
    checkpoint = find_checkpoint(policy, results_dir)
    source = run_folder(checkpoint.path)
    weights = (checkpoint.path / WEIGHTS).read_bytes()
    contents: dict[str, bytes | str] = {
        WEIGHTS: weights,
        MANIFEST: weights_manifest(checkpoint, weights),
        CONFIGURATION: (source / CONFIGURATION).read_bytes(),
        METADATA: find_metadata(source).to_json(),
    }
    if (folder / CHECKPOINTS).is_dir():
        raise UserError(f"{folder}: this is a run: choose another folder")
    if not force and (taken := [name for name in contents if (folder / name).exists()]):
        raise UserError(
            f"{folder}: {', '.join(taken)} would be replaced: choose another folder, or --force"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            write_atomically(folder / name, content)
    except OSError as error:
        raise UserError(f"{folder}: can't be written: {error.strerror}") from error


if __name__ == "__main__":
    sys.exit(main())
