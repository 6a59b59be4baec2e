"""Files that are either there in full or not there at all."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from trainers.common.errors import UnwritableError


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let every OSError that is raised meanwhile name `path`.

    The operating system's own errors (a full disk, say) often name no file at all, or a temporary
    one that means nothing to the user.

    Raises:
        UnwritableError: with `path` as its file name.
    """
    try:
        yield
    except OSError as error:
        reason = f"cannot write: {error.strerror or error}"
        raise UnwritableError(error.errno, reason, str(path)) from error


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Waits until no other process is in such a context with this folder.

    Where the filesystem knows no such locks it waits for nobody.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def sync(path: Path) -> None:
    """Wait until a file's content, or a directory's list of names, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_json(path: Path) -> Any:
    """The content of a JSON file, whoever wrote it.

    Raises:
        OSError: it can't be read.
        ValueError: it is no JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def write_atomically(path: Path, data: bytes | str) -> None:
    """Write a file so that a reader, or a crash, sees the old content or the new, never a part.

    The data go into a hidden file beside `path`, which is fsynced and then renamed. One process
    at a time may write the same path.

    Args:
        path: the file to write; its directory must exist.
        data: the whole content; text is written as UTF-8.

    Raises:
        UnwritableError: what was there before is untouched.
    """
    content = data.encode() if isinstance(data, str) else data
    beside = temporary(path)
    with naming(path):
        try:
            with beside.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(path)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
        sync(path.parent)


def temporary(path: Path) -> Path:
    """The file that `write_atomically` writes for another one.

    Always the same: what an interrupted write left behind is overwritten by the next one.
    """
    return path.with_name(f".{path.name}.tmp")
