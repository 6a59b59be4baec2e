"""The command line: `ventosa init quick` copies a run file to begin with."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from trainers.common.command import DONE, tells_failures
from trainers.common.errors import UserError, suggestion
from trainers.common.files import naming, write_atomically
from trainers.console.shipped import (
    CONFIG,
    policies,
    run_files,
    shipped_folder,
    title,
    with_named_files,
)


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Copies what is named, or lists what there is; returns the exit code."""
    options = parse(arguments)
    if options.name is None:
        print("\n".join(listed(shipped_folder())))
        return DONE
    for path in copy(options.name, options.folder, force=options.force):
        print(path)
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="ventosa init",
        description="Copy a run file that comes with ventosa, and those it extends, or a policy.",
    )
    parser.add_argument("name", nargs="?", help="such as quick or paper/lstm; none: list them")
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="default: here")
    parser.add_argument("--force", action="store_true", help="overwrite files that differ")
    return parser.parse_args(arguments)


def listed(folder: Path) -> Iterator[str]:
    """Names of all that can be copied, with what they are, as far as a line has room."""
    there = run_files(folder) | policies(folder)
    width, columns = max(map(len, there)), shutil.get_terminal_size().columns
    for name, path in there.items():
        yield f"{name:<{width}}  {title(path)}"[:columns]


def copy(name: str, folder: Path, *, force: bool = False) -> list[Path]:
    """Copies a run file or a policy, under the name that it has here; returns what was written.

    Args:
        name: of a run file or a policy.
        folder: where to.
        force: overwrite files that are there and differ.

    Raises:
        UserError: there is nothing of that name, or a file is there and differs.
    """
    sources = _sources(name.removesuffix(".yaml"))
    content = {folder / target: path.read_bytes() for target, path in sources.items()}
    missing = {path: data for path, data in content.items() if not _holds(path, data)}
    for path in missing:
        if path.exists() and not force:
            raise UserError(f"{path} is there already, and differs: name a FOLDER, or say --force")
    for path, data in missing.items():
        with naming(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, data)
    return list(content)


def _sources(name: str) -> dict[Path, Path]:
    """Files by where they go to, as seen from the folder."""
    home = shipped_folder()
    runs, trained = run_files(home), policies(home)
    if name in runs:
        return {p.relative_to(home / CONFIG): p for p in with_named_files(runs[name])}
    if name in trained:
        return {p.relative_to(home): p for p in sorted(trained[name].iterdir()) if p.is_file()}
    raise UserError(f"{name!r} does not come with ventosa; {suggestion(name, {**runs, **trained})}")


def _holds(path: Path, data: bytes) -> bool:
    return path.is_file() and path.read_bytes() == data
