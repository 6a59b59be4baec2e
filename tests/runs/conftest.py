"""What tests of whole runs share."""

from __future__ import annotations

import os
import signal
import sysconfig
import venv
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

TASKS = Path("/proc/self/task")


def children() -> set[int]:
    """Processes of this one, but for those that serve all of its tests (multiprocessing's)."""
    pids = [int(p) for path in TASKS.glob("*/children") for p in path.read_text().split()]
    return {pid for pid in pids if b"multiprocessing" not in commands(pid)}


def commands(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:  # it has ended
        return b"multiprocessing"


@pytest.fixture(autouse=True)
def _no_process_outlives_its_test() -> Iterator[None]:
    """Kills what a test that failed has left: a run of a billion steps would slow all others."""
    before = children()
    yield
    for pid in children() - before:
        os.kill(pid, signal.SIGKILL)


@pytest.fixture(scope="session")
def borrowing_venv() -> Callable[[Path], Path]:
    """Makes a virtual environment that borrows all packages from this one: its scripts' folder."""

    def make(home: Path) -> Path:
        venv.create(home)
        paths = {"base": str(home), "platbase": str(home)}
        borrowed = Path(sysconfig.get_path("purelib", "venv", vars=paths)) / "borrowed.pth"
        ours = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
        borrowed.write_text("\n".join(ours))
        return Path(sysconfig.get_path("scripts", "venv", vars=paths))

    return make
