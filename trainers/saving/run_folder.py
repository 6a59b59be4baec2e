"""A run's folder under the results: `<results>/<run id>/`."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from trainers.common.errors import UserError
from trainers.common.files import write_atomically
from trainers.loggers.base import IDENTIFIERS
from trainers.saving import checkpoint, evaluation_folder
from trainers.saving.checkpoint import MANIFEST, Checkpoints, Loaded
from trainers.saving.evaluation_folder import EVALUATION
from trainers.saving.run_lock import LOCK, RunLock

CONFIGURATION = "configuration.yaml"
CHECKPOINTS = "checkpoints"

_NAMES = "|".join(
    map(re.escape, (CONFIGURATION, IDENTIFIERS, "policy.json", "status.json", "timers.json"))
)
_FILE = re.compile(rf"{_NAMES}|\.({_NAMES})\.tmp|events\.out\.tfevents\..+")
"""Names of a run's own files, as `trainers.run` and its log write them."""
_FOLDERS = {CHECKPOINTS: checkpoint.own_names, EVALUATION: evaluation_folder.own_names}
"""A run's folders, and what finds the names of its own in them."""


def run_name(name: str) -> str:
    """A run's name, which is that of its folder in the results.

    Raises:
        UserError: it is none.
    """
    if not name or name.startswith(".") or not name.isprintable() or {"/", "\\"} & set(name):
        raise UserError(
            f"--run-id {name!r}: a run's name is that of a folder in --results-dir: not empty, no "
            "path, and no dot at its beginning"
        )
    return name


def claim(directory: Path, *, resume: bool, force: bool) -> RunLock:
    """Makes a run's folder this process's own, before anything in it changes.

    Args:
        directory: the run's folder.
        resume: go on with the run that is there.
        force: replace the run that is there.

    Returns:
        The folder's lock, to be closed when the run ends.

    Raises:
        UserError: the folder is taken, has nothing to resume, or can't be written.
    """
    with _blaming_the_results_dir(directory):
        lock = RunLock(directory)
        try:
            _check(directory, resume, force)
        except BaseException:
            lock.close()
            raise
    return lock


def _check(directory: Path, resume: bool, force: bool) -> None:
    if resume:
        if not has_checkpoints(directory):
            raise UserError(
                f"{directory}: there is no checkpoint to resume; start the run without --resume"
            )
        return
    own, foreign = contents(directory)
    if not force and (own or foreign):
        raise UserError(
            f"{directory}: this run exists already: go on with it (--resume), replace it "
            "(--force), or choose another --run-id"
        )
    _refuse(foreign)


def begin(directory: Path, files: Mapping[str, str], *, resume: bool) -> None:
    """Makes a run's folder ready, and writes into it what its policies are loaded by.

    Comes after `claim`, and as late as can be: what it replaces is gone.

    Args:
        directory: the run's folder.
        files: names and contents: the resolved run file, and what policies say of themselves.
        resume: keep what is there.

    Raises:
        UserError: the folder can't be written, or holds what no run wrote.
    """
    with _blaming_the_results_dir(directory):
        directory.mkdir(parents=True, exist_ok=True)
        if not resume:
            _remove_run(directory)
        for name, content in files.items():
            write_atomically(directory / name, content)


def contents(directory: Path) -> tuple[list[Path], list[Path]]:
    """What a run, and evaluations of it, wrote into its folder; and what is not theirs.

    The lock is neither; folders come after what is in them, checkpoints whole.
    """
    own: list[Path] = []
    foreign: list[Path] = []
    for path in sorted(directory.iterdir()):
        names_within = _FOLDERS.get(path.name)
        if path.is_symlink():
            foreign.append(path)
        elif names_within is not None and path.is_dir():
            names = names_within(path)
            for inner in sorted(path.iterdir()):
                (own if inner.name in names else foreign).append(inner)
            own.append(path)
        elif path.name != LOCK:
            (own if _FILE.fullmatch(path.name) and path.is_file() else foreign).append(path)
    return own, foreign


def _remove_run(directory: Path) -> None:
    """Removes what a run wrote, by its names: what is not its own stays whoever puts it there."""
    own, foreign = contents(directory)
    _refuse(foreign)
    for path in own:
        if not path.is_dir():
            path.unlink()
        elif path.parent == directory:
            path.rmdir()
        else:
            shutil.rmtree(path)


def _refuse(foreign: Sequence[Path]) -> None:
    if foreign:
        raise UserError(
            f"{foreign[0]}: no run wrote this, and --force replaces nothing but a run: move it "
            "away, or choose another --run-id"
        )


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
