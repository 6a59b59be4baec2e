"""Checkpoints that survive a crash at any moment: whole or not there, checked when read.

```
checkpoints/
  step-<N>/
    weights.safetensors   what the policy has learned; all that evaluation needs
    state.safetensors     the arrays of everything else (optimizers, normalizers, random states)
    state.json            the rest of it
    manifest.json         size and sha256 of each, step, score
  latest.json  best.json  which folder is which, for people and other programs
```
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy
import safetensors.torch
import torch
from pydantic import BaseModel, Field, FiniteFloat, NonNegativeInt, ValidationError

from trainers.common.errors import UserError, reason
from trainers.common.files import naming, read_json, sync, write_atomically
from trainers.saving.serialization import flatten, unflatten

FORMAT = 1
WEIGHTS = "weights.safetensors"
STATE_ARRAYS = "state.safetensors"
STATE = "state.json"
MANIFEST = "manifest.json"

LOOKS = 5
"""At checkpoints that change while they are read, at most."""

_FOLDER = re.compile(r"step-(\d+)")
_LEFTOVER = re.compile(r"\.step-(\d+)\.(tmp|old)-\w+")
_MARKER = re.compile(r"(latest|best)\.json|\.(latest|best)\.json\.tmp")


class CheckpointError(UserError):
    """No usable checkpoint; the message says where, why, and the way out."""


@dataclass(frozen=True)
class Loaded:
    """Content of a checkpoint.

    Attributes:
        step: environment steps taken when it was saved.
        weights: the policy's tensors by name, on the CPU.
        state: everything else, as it was given to `Checkpoints.save`; None where it was not asked
            for.
        path: the checkpoint's folder.
        score: what it was saved with, higher is better.
        score_of: what that measures; empty where it was saved before this was said.
        notes: for the user: which checkpoints were passed over before this one, and why.
    """

    step: int
    weights: dict[str, torch.Tensor]
    state: Any
    path: Path
    score: float | None
    score_of: str
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class CheckpointInfo:
    """Facts of a checkpoint that are known without reading it.

    Attributes:
        step: environment steps taken when it was saved.
        path: its folder.
        score: higher is better; None where it was saved without one.
        score_of: what that measures; empty where it was saved before this was said.
        serial: the order in which the checkpoints were saved, which is not always that of the
            steps: a run that went back to an earlier checkpoint goes on from there. None where
            the manifest can't be read.
    """

    step: int
    path: Path
    score: float | None
    score_of: str
    serial: int | None


class _FileRecord(BaseModel, frozen=True):
    size: NonNegativeInt
    sha256: str


class _Manifest(BaseModel, frozen=True):
    format: int
    step: int = Field(ge=0, lt=2**63)
    serial: int = Field(ge=0, lt=2**63)
    score: FiniteFloat | None
    score_of: str = ""
    files: dict[str, _FileRecord]


class _DamageError(Exception):
    """Why a checkpoint can't be used."""


class Checkpoints:
    """The checkpoints of one run: saves, prunes, and finds the latest and the best.

    Only one process may save into a directory at a time. Reading needs no write permission.
    """

    def __init__(self, directory: Path, keep: int) -> None:
        """Look after a directory; it is created at the first save.

        Args:
            directory: where the checkpoints lie.
            keep: how many of the newest to keep (the best one is always kept).

        Raises:
            ValueError: `keep` is less than 1.
        """
        if keep < 1:
            raise ValueError(f"keep is {keep}, but at least one checkpoint must be kept")
        self.directory = directory
        self.keep = keep

    def save(
        self,
        step: int,
        weights: Mapping[str, torch.Tensor],
        state: Any,
        score: float | None,
        score_of: str = "",
    ) -> Path:
        """Save a checkpoint, mark it, and remove those no longer needed.

        A checkpoint of the same step is replaced; its score stays if its weights are the same and
        there is no new one. A crash at any moment leaves at least the checkpoints that were there
        before.

        Args:
            step: environment steps taken.
            weights: tensors by name; all that evaluation needs.
            state: nested state as `trainers.saving.serialization.flatten` takes it.
            score: higher is better; None (or NaN) where there is none yet.
            score_of: what it measures, also where there is none yet; only scores of the same are
                compared.

        Returns:
            The checkpoint's folder, `step-<step>`.

        Raises:
            TypeError: the state holds something that can't be saved; nothing is written.
            OSError: nothing can be written there (a full disk, say); names the folder.
        """
        path = self.directory / f"step-{step}"
        skeleton, arrays = flatten(state)
        with naming(path):
            self.directory.mkdir(parents=True, exist_ok=True)
            self._clear_leftovers()
            temporary = self.directory / f".step-{step}.tmp-{secrets.token_hex(4)}"
            try:
                temporary.mkdir()
                _write_weights(temporary / WEIGHTS, weights)
                _write_safetensors(temporary / STATE_ARRAYS, arrays)
                (temporary / STATE).write_text(json.dumps(skeleton, allow_nan=False))
                self._write_manifest(temporary, step, score, score_of)
                _move_into_place(temporary, path)
            except BaseException:
                shutil.rmtree(temporary, ignore_errors=True)
                raise
            self._mark_and_prune()
        return path

    @property
    def empty(self) -> bool:
        """Whether there is no checkpoint, not even a damaged one."""
        return not self._entries()

    def list_checkpoints(self) -> list[CheckpointInfo]:
        """Checkpoints with a readable manifest, in the order in which they were saved.

        Their contents are not checked.
        """
        readable = [entry for entry in self._entries() if entry.serial is not None]
        return sorted(readable, key=_age_order)

    @property
    def best(self) -> CheckpointInfo:
        """The one that `load_best` would load, if it is not damaged; there has to be one."""
        return _by_merit(self._entries())[0]

    def load_latest(self, *, with_state: bool = True) -> Loaded:
        """Load the checkpoint saved last, or the newest that is not damaged.

        Args:
            with_state: False for the weights alone: nothing else is read or checked.

        Returns:
            The checkpoint; its notes name those passed over because they are damaged.

        Raises:
            CheckpointError: there is none that can be used.
        """
        return self._load_first(
            lambda entries: sorted(entries, key=_age_order, reverse=True), with_state
        )

    def load_best(self, *, with_state: bool = True) -> Loaded:
        """Load the checkpoint with the highest score (the later one where two are equal).

        Falls back as `load_latest` does. Checkpoints without a score, or with one of something else
        than the newest checkpoint's, come last, newest first.

        Args:
            with_state: False for the weights alone: nothing else is read or checked.

        Raises:
            CheckpointError: there is none that can be used.
        """
        return self._load_first(_by_merit, with_state)

    @staticmethod
    def load(path: Path, *, with_state: bool = True) -> Loaded:
        """Load one checkpoint folder, checked against its manifest.

        Args:
            path: the folder.
            with_state: False for the weights alone: nothing else is read or checked.

        Raises:
            CheckpointError: it is damaged, or is no checkpoint.
        """
        try:
            return _read(path, with_state)
        except _DamageError as damage:
            raise CheckpointError(
                f"{path} can't be used as a checkpoint: {damage}. Give another checkpoint folder "
                f"(step-<N>), such as an earlier one of the same run."
            ) from damage

    def _load_first(
        self, ordered: Callable[[list[CheckpointInfo]], list[CheckpointInfo]], with_state: bool
    ) -> Loaded:
        """The first that can be used, in an order; anew where a run saves and prunes meanwhile."""
        for _ in range(LOOKS):
            entries, notes, loaded = self._entries(), list[str](), None
            for entry in ordered(entries):
                try:
                    loaded = _read(entry.path, with_state)
                    break
                except _DamageError as damage:
                    notes.append(f"passed over the damaged checkpoint {entry.path}: {damage}")
            if not notes or set(entries) == set(self._entries()):
                break
        if loaded is not None:
            return replace(loaded, notes=notes)
        if not notes:
            raise CheckpointError(
                f"there is no checkpoint in {self.directory}: check the path, or start the run "
                f"afresh"
            )
        raise CheckpointError(
            f"no checkpoint in {self.directory} can be used: put a copy of a good one back, or "
            f"start the run afresh\n  " + "\n  ".join(notes)
        )

    def _entries(self) -> list[CheckpointInfo]:
        """Every checkpoint folder, readable or not, in no particular order."""
        folders: dict[int, Path] = {}
        for path in self._subfolders():
            if match := _FOLDER.fullmatch(path.name):
                folders[int(match[1])] = path
            # One put aside for its replacement still counts if the replacement never came.
            elif (match := _LEFTOVER.fullmatch(path.name)) and match[2] == "old":
                folders.setdefault(int(match[1]), path)
        return [_info(step, path) for step, path in folders.items()]

    def _subfolders(self) -> Iterator[Path]:
        if self.directory.is_dir():
            yield from (path for path in self.directory.iterdir() if path.is_dir())

    def _clear_leftovers(self) -> None:
        """Finish or undo what an interrupted save or pruning left half done."""
        for path in list(self._subfolders()):
            match = _LEFTOVER.fullmatch(path.name)
            if not match:
                continue
            final = self.directory / f"step-{match[1]}"
            if match[2] == "old" and not final.exists():
                path.rename(final)
            else:
                _remove(path)

    def _write_manifest(self, folder: Path, step: int, score: float | None, score_of: str) -> None:
        """Describe the folder's files in its manifest and put everything on the disk."""
        serials = [entry.serial for entry in self._entries() if entry.serial is not None]
        files = {
            name: _FileRecord(size=(folder / name).stat().st_size, sha256=_digest(folder / name))
            for name in (WEIGHTS, STATE_ARRAYS, STATE)
        }
        if score is None or not math.isfinite(score):
            score = _known_score(self.directory / f"step-{step}", files[WEIGHTS], score_of)
        manifest = _Manifest(
            format=FORMAT,
            step=step,
            serial=max(serials, default=0) + 1,
            score=None if score is None else float(score),
            score_of=score_of,
            files=files,
        )
        (folder / MANIFEST).write_text(manifest.model_dump_json(indent=2))
        for file in folder.iterdir():
            sync(file)
        sync(folder)

    def _mark_and_prune(self) -> None:
        whole = sorted((e for e in self._entries() if _has_right_sizes(e.path)), key=_age_order)
        best = _by_merit(whole)[0]
        # Markers first: they must never name a folder that is gone.
        self._mark("latest", whole[-1])
        self._mark("best", best)
        kept = {entry.path for entry in (*whole[-self.keep :], best)}
        for path in list(self._subfolders()):
            if (match := _FOLDER.fullmatch(path.name)) and path not in kept:
                # Renamed first, so that an interrupted removal doesn't look like a damaged one.
                doomed = self.directory / f".step-{match[1]}.tmp-{secrets.token_hex(4)}"
                path.rename(doomed)
                _remove(doomed)

    def _mark(self, name: str, entry: CheckpointInfo) -> None:
        content = {"step": entry.step, "checkpoint": entry.path.name, "score": entry.score}
        write_atomically(self.directory / f"{name}.json", json.dumps(content))


def own_names(directory: Path) -> set[str]:
    """Names of what `Checkpoints` wrote into a directory: folders, markers, and what a crash left.

    A folder is known by its name alone.
    """
    return {
        path.name
        for path in directory.iterdir()
        if (
            _FOLDER.fullmatch(path.name) or _LEFTOVER.fullmatch(path.name)
            if path.is_dir() and not path.is_symlink()
            else _MARKER.fullmatch(path.name)
        )
    }


def weights_manifest(checkpoint: Loaded, weights: bytes) -> str:
    """The manifest of a checkpoint of which nothing but the file of weights is kept."""
    record = _FileRecord(size=len(weights), sha256=hashlib.sha256(weights).hexdigest())
    return _Manifest(
        format=FORMAT,
        step=checkpoint.step,
        serial=1,
        score=checkpoint.score,
        score_of=checkpoint.score_of,
        files={WEIGHTS: record},
    ).model_dump_json(indent=2)


def _age_order(entry: CheckpointInfo) -> tuple[float, int]:
    # Unreadable ones count as newest, so that they are reported instead of forgotten.
    return (math.inf if entry.serial is None else entry.serial, entry.step)


def _by_merit(entries: list[CheckpointInfo]) -> list[CheckpointInfo]:
    """The best first; scores are compared that are of the same as the newest checkpoint's."""
    newest_first = sorted(entries, key=_age_order, reverse=True)
    score_of = next((entry.score_of for entry in newest_first if entry.serial is not None), "")

    def merit(entry: CheckpointInfo) -> float:
        if entry.score is None or entry.score_of != score_of:
            return -math.inf
        return entry.score

    return sorted(newest_first, key=merit, reverse=True)


def _write_weights(path: Path, weights: Mapping[str, torch.Tensor]) -> None:
    # Cloned, because safetensors refuses tensors that share memory, as tied weights do.
    own = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, tensor in weights.items()
    }
    _write_safetensors(path, own, torch_tensors=True)


def _write_safetensors(path: Path, content: Any, *, torch_tensors: bool = False) -> None:
    save_file = safetensors.torch.save_file if torch_tensors else safetensors.numpy.save_file
    path.touch()
    mode = path.stat().st_mode
    try:
        save_file(content, path)
    except safetensors.SafetensorError as error:  # this is how it reports a full disk
        raise OSError(str(error)) from error
    path.chmod(mode)  # safetensors lets nobody else read what it writes; the user's umask decides


def _move_into_place(temporary: Path, path: Path) -> None:
    """Rename a finished folder; what was there is put aside first, and removed last."""
    aside = None
    if os.path.lexists(path):
        aside = path.with_name(f".{path.name}.old-{secrets.token_hex(4)}")
        path.rename(aside)
    temporary.rename(path)
    sync(path.parent)
    if aside:
        _remove(aside)


def _remove(folder: Path) -> None:
    """Removes a checkpoint; of one that a link leads to, the link alone."""
    if folder.is_symlink():
        folder.unlink()
    else:
        shutil.rmtree(folder)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _info(step: int, path: Path) -> CheckpointInfo:
    try:
        manifest = _read_manifest(path)
    except _DamageError:
        return CheckpointInfo(step, path, score=None, score_of="", serial=None)
    return CheckpointInfo(step, path, manifest.score, manifest.score_of, manifest.serial)


def _known_score(path: Path, weights: _FileRecord, score_of: str) -> float | None:
    """Score of the checkpoint at a path if it is of these very weights, and of the same kind."""
    try:
        manifest = _read_manifest(path)
    except _DamageError:
        return None
    same = manifest.files.get(WEIGHTS) == weights and manifest.score_of == score_of
    return manifest.score if same else None


def _has_right_sizes(path: Path) -> bool:
    try:
        manifest = _read_manifest(path)
        for name in manifest.files:
            _check_size(path, name, manifest)
    except _DamageError:
        return False
    return True


def _read(path: Path, with_state: bool) -> Loaded:
    manifest = _read_manifest(path)
    for name in (WEIGHTS, STATE_ARRAYS, STATE) if with_state else (WEIGHTS,):
        _check_size(path, name, manifest)
        _check_content(path, name, manifest)
    with _blaming(WEIGHTS):
        weights = safetensors.torch.load_file(path / WEIGHTS)
    for name, tensor in weights.items():
        if tensor.isnan().any():
            raise _DamageError(f"{WEIGHTS}: {name} has values that are not numbers (NaN)")
    state = None
    if with_state:
        with _blaming(STATE_ARRAYS):
            arrays = safetensors.numpy.load_file(path / STATE_ARRAYS)
        with _blaming(STATE):
            state = unflatten(read_json(path / STATE), arrays)
    return Loaded(manifest.step, weights, state, path, manifest.score, manifest.score_of)


@contextmanager
def _blaming(name: str) -> Iterator[None]:
    """Calls whatever a file's content leads to damage: forged, it may be of any shape."""
    try:
        yield
    except Exception as error:
        raise _DamageError(f"the content of {name} can't be used: {reason(error)}") from error


def _read_manifest(path: Path) -> _Manifest:
    try:
        content = (path / MANIFEST).read_bytes()
        manifest = _Manifest.model_validate_json(content, strict=True)
    except FileNotFoundError as error:
        raise _DamageError(f"there is no {MANIFEST} in it") from error
    except OSError as error:
        raise _DamageError(f"{MANIFEST} can't be read: {error.strerror}") from error
    except ValidationError as error:
        raise _DamageError(f"{MANIFEST} is cut short or damaged: {reason(error)}") from error
    if manifest.format != FORMAT:
        raise _DamageError(f"it has format {manifest.format}, this version reads {FORMAT}")
    return manifest


def _check_size(path: Path, name: str, manifest: _Manifest) -> None:
    if name not in manifest.files:
        raise _DamageError(f"{MANIFEST} doesn't list {name}")
    expected = manifest.files[name].size
    try:
        size = os.stat(path / name).st_size
    except OSError as error:
        raise _DamageError(f"{name} can't be read: {error.strerror}") from error
    if size != expected:
        what = "is cut short" if size < expected else "is too long"
        raise _DamageError(f"{name} {what}: {size} bytes, should be {expected}")


def _check_content(path: Path, name: str, manifest: _Manifest) -> None:
    try:
        digest = _digest(path / name)
    except OSError as error:
        raise _DamageError(f"{name} can't be read: {error.strerror}") from error
    if digest != manifest.files[name].sha256:
        raise _DamageError(f"the content of {name} doesn't match its checksum")
