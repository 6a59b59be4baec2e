"""A sweep's journal file, in which a process that was killed may have left half a line."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock

BEGINNING = b'{"op_code":'
"""Of each line of Optuna's."""
_logger = logging.getLogger("ventosa")


def open_journal(path: Path) -> JournalStorage:
    """The storage in a file, which is made where there is none.

    What was not written to its end was never told to anyone. Left there, it would be one with the
    next line, and neither could be read: it is cut off.

    Raises:
        OSError: the file can't be read or written.
    """
    # The lock is a link to the file, of which Optuna asks how old it is: one that a killed process
    # left behind is only ever taken over if the link leads somewhere from its own folder, too.
    path = path.absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = JournalFileSymlinkLock(str(path))
    backend = JournalFileBackend(str(path), lock)
    lock.acquire()  # others may be writing
    try:
        _cut_half_a_line(path)
    finally:
        lock.release()
    return JournalStorage(backend)


def _cut_half_a_line(path: Path) -> None:
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if content.startswith(BEGINNING) and whole < len(content):  # no file of another kind
        _logger.warning(
            "%s: the last line was not written to its end, and is left out: %r",
            path,
            content[whole:],
        )
        os.truncate(path, whole)
