"""One run, one writer: the lock in a run's folder, which says who writes there."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from datetime import datetime
from pathlib import Path

from pydantic import BaseModel, ValidationError

from trainers.common.errors import UserError

LOCK = "run.lock"
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
RETRIES = 1_000  # as others remove folder or file just then, each time
LOOKS, LOOK_S = 5, 0.02  # who asks whether a lock is held has it meanwhile, see `is_held`


class Holder(BaseModel, frozen=True):
    """Process that writes into a run's folder."""

    pid: int
    host: str
    boot: str
    """Of the machine since it was switched on; containers on it share it, whatever their names."""
    started: str

    @classmethod
    def this_process(cls) -> Holder:
        """The present process."""
        boot = BOOT_ID.read_text().strip() if BOOT_ID.exists() else ""
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        return cls(pid=os.getpid(), host=socket.gethostname(), boot=boot, started=now)

    def is_near(self, other: Holder) -> bool:
        """Whether another is on the same machine, where locks are certain to be seen."""
        return self.host == other.host or bool(self.boot and self.boot == other.boot)

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.started}"


class RunLock:
    """The lock of a run's folder, held until it is closed.

    The folder is made where it does not exist, and removed again if nothing else came into it. The
    lock is the system's and belongs to this process alone: it ends with it, however it ends, also
    where a worker outlives it. What a killed process left in the file is therefore taken over. Only
    on a filesystem of several machines may a lock of another one go unseen: what it says is
    believed then.

    A process may hold a folder's lock once, and not open the file beside it (POSIX).

    Args:
        directory: the run's folder.

    Raises:
        UserError: another process holds it, or may hold it on another machine.
        OSError: the folder can't be written.
    """

    def __init__(self, directory: Path):
        self._path = directory / LOCK
        self._made = [path for path in (directory, *directory.parents) if not path.exists()]
        self._descriptor = descriptor = self._locked()
        try:
            me, before = Holder.this_process(), _read(descriptor)
            if before is not None and not before.is_near(me):
                raise UserError(
                    f"{directory}: {before}, writes into this run, or was cut off there, which "
                    f"can't be told from here: if it is over, remove {self._path}"
                )
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, me.model_dump_json().encode(), 0)
        except BaseException:
            os.close(descriptor)
            raise

    def close(self) -> None:
        """Gives the folder up."""
        if _is_at(self._descriptor, self._path):
            self._path.unlink()
        os.close(self._descriptor)
        for folder in self._made:
            try:
                folder.rmdir()
            except OSError:  # something came into it
                break

    def _locked(self) -> int:
        """The locked file in its folder, both made anew where another process removes them."""
        for _ in range(RETRIES):
            try:
                return self._try_to_lock()
            except (FileNotFoundError, FileExistsError):
                # The folder, one above it or the file went while it was made, looked at or opened.
                pass
        return self._try_to_lock()

    def _try_to_lock(self) -> int:
        """The locked file.

        Raises:
            UserError: another process holds it.
            FileNotFoundError: folder or file was removed meanwhile, or can never be made.
            FileExistsError: the same of the folder, or a file is in its place.
        """
        self._path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            _lock(descriptor)
            if not _is_at(descriptor, self._path):
                raise FileNotFoundError(f"{self._path}: was removed by the process that held it")
        except BlockingIOError as error:
            holder = _read(descriptor) or "another process"
            os.close(descriptor)
            raise UserError(
                f"{self._path.parent}: this run is going on: {holder}, writes into it; stop it, or "
                "choose another --run-id"
            ) from error
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor


def is_held(directory: Path) -> bool:
    """Whether another process writes into a run's folder, as far as can be told from here."""
    try:
        descriptor = os.open(directory / LOCK, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        holder = _read(descriptor)
        if holder is not None and not holder.is_near(Holder.this_process()):
            return True
        fcntl.lockf(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def _lock(descriptor: int) -> None:
    """Takes the system's lock; BlockingIOError where another process keeps it."""
    for look in range(LOOKS):
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if look == LOOKS - 1:
                raise
            time.sleep(LOOK_S)


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file still has its name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _read(descriptor: int) -> Holder | None:
    """Who wrote the file; None where that is not said, or not yet in full."""
    try:
        return Holder.model_validate_json(os.pread(descriptor, 4096, 0))
    except ValidationError:
        return None
