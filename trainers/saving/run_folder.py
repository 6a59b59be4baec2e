"""A run's folder under the results: `<results>/<run id>/`."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from trainers.common.errors import UserError
from trainers.common.files import write_atomically
from trainers.saving.checkpoint import MANIFEST, Checkpoints, Loaded

CONFIGURATION = "configuration.yaml"
CHECKPOINTS = "checkpoints"


def check(directory: Path, *, resume: bool, force: bool) -> None:
    """Sees whether a run may have a folder; changes nothing.

    Args:
        directory: the run's folder.
        resume: go on with the run that is there.
        force: replace the run that is there.

    Raises:
        UserError: the folder is taken, has nothing to resume, or can't be read.
    """
    with _blaming_the_results_dir(directory):
        if resume:
            if not has_checkpoints(directory):
                raise UserError(
                    f"{directory}: there is no checkpoint to resume; start the run without --resume"
                )
        elif directory.exists() and any(directory.iterdir()):
            if not force:
                raise UserError(
                    f"{directory}: this run exists already: go on with it (--resume), replace it "
                    "(--force), or choose another --run-id"
                )
            if not (directory / CONFIGURATION).is_file():
                raise UserError(
                    f"{directory}: --force deletes runs, and this is none (it has no "
                    f"{CONFIGURATION}); choose another --run-id"
                )
            if (directory / MANIFEST).is_file():
                raise UserError(
                    f"{directory}: --force deletes runs, and this is an exported policy; choose "
                    "another --run-id"
                )


def begin(directory: Path, files: Mapping[str, str], *, resume: bool) -> None:
    """Makes a run's folder ready, and writes into it what its policies are loaded by.

    Comes after `check`, and as late as can be: what it replaces is gone.

    Args:
        directory: the run's folder.
        files: names and contents: the resolved run file, and what policies say of themselves.
        resume: keep what is there.

    Raises:
        UserError: the folder can't be written.
    """
    with _blaming_the_results_dir(directory):
        if directory.exists() and not resume:
            shutil.rmtree(directory)
        directory.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomically(directory / name, content)


@contextmanager
def _blaming_the_results_dir(directory: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        where = error.filename or directory
        raise UserError(
            f"{where}: the run's folder can't be written: {error.strerror or error}; "
            "choose another --results-dir"
        ) from error


def has_checkpoints(directory: Path) -> bool:
    """Whether a run's folder has any checkpoint."""
    return not Checkpoints(directory / CHECKPOINTS, keep=1).empty


def find_checkpoint(name: str, results_dir: Path) -> Loaded:
    """The weights of a run (its best), by its folder or its id, or of a checkpoint's folder.

    An exported policy is such a folder, too.

    Raises:
        UserError: there is none.
    """
    folder = _find(name, results_dir)
    if (folder / CHECKPOINTS).is_dir():
        return Checkpoints(folder / CHECKPOINTS, keep=1).load_best(with_state=False)
    return Checkpoints.load(folder, with_state=False)


def find_run_folder(name: str, results_dir: Path) -> Path:
    """The run's folder of what `find_checkpoint` finds; nothing in it is read.

    Raises:
        UserError: there is none.
    """
    folder = _find(name, results_dir)
    return folder if (folder / CHECKPOINTS).is_dir() else run_folder(folder)


def _find(name: str, results_dir: Path) -> Path:
    for folder in (Path(name), results_dir / name):
        if (folder / CHECKPOINTS).is_dir() or (folder / MANIFEST).is_file():
            return folder
    raise UserError(f"{name}: neither a run nor a checkpoint, as it stands or under {results_dir}")


def run_folder(checkpoint: Path) -> Path:
    """The folder of the run a checkpoint belongs to; an exported policy brings its own.

    Raises:
        UserError: there is no run file, neither with the policy nor where the run would be.
    """
    own = checkpoint.resolve()
    for folder in (own, own.parents[1]):
        if (folder / CONFIGURATION).is_file():
            return folder
    raise UserError(
        f"{checkpoint}: its {CONFIGURATION} is not there, which says what the policy is made of: "
        "name a run, a checkpoint where the run left it, or an exported policy"
    )
