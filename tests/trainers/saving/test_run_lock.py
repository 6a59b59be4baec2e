"""The lock of a run's folder, against other processes."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from trainers.common.errors import UserError
from trainers.saving.run_lock import LOCK, Holder, RunLock, is_held

REPOSITORY = Path(__file__).parents[3]
HOLD = """
import os, sys, time
from pathlib import Path
from trainers.saving.run_lock import RunLock
lock = RunLock(Path(sys.argv[1]))
worker = os.fork()
if worker:
    print(worker, flush=True)
time.sleep(300)
"""


@contextmanager
def holder(directory: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Another process that holds a folder, and the process id of its worker."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(directory)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    try:
        yield process, worker
    finally:
        os.kill(worker, signal.SIGKILL)
        process.kill()
        process.communicate()


def test_the_process_that_holds_it_is_named_and_a_killed_one_is_taken_over(tmp_path: Path) -> None:
    with holder(tmp_path / "run") as (process, _):
        with pytest.raises(UserError) as refused:
            RunLock(tmp_path / "run")
        assert f"{tmp_path / 'run'}: this run is going on: process {process.pid} on " in str(
            refused.value
        )
        assert json.loads((tmp_path / "run" / LOCK).read_text())["pid"] == process.pid
        assert is_held(tmp_path / "run")
        process.kill()
        process.wait()
        assert not is_held(tmp_path / "run")
        lock = RunLock(tmp_path / "run")  # though its worker has outlived it
        assert json.loads((tmp_path / "run" / LOCK).read_text())["pid"] == os.getpid()
        lock.close()
    assert list((tmp_path / "run").iterdir()) == []  # it was there before this lock


def left_behind(directory: Path, **fields: str) -> Path:
    """The lock file of a process that was killed."""
    text = Holder.this_process().model_copy(update=fields).model_dump_json()
    (directory / LOCK).write_text(text)
    return directory / LOCK


def test_another_machine_is_believed(tmp_path: Path) -> None:
    path = left_behind(tmp_path, host="elsewhere", boot="another")
    before = path.read_text()
    with pytest.raises(UserError, match=rf"on elsewhere, since .*: if it is over, remove {path}"):
        RunLock(tmp_path)
    assert is_held(tmp_path)
    assert path.read_text() == before


@pytest.mark.parametrize("fields", [{"host": "a-container"}, {"boot": "before it was restarted"}])
def test_the_same_machine_under_another_name_or_restarted_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fields: dict[str, str]
) -> None:
    boot = tmp_path / "boot_id"
    boot.write_text("this one\n")
    monkeypatch.setattr("trainers.saving.run_lock.BOOT_ID", boot)
    path = left_behind(tmp_path, **fields)
    assert not is_held(tmp_path)
    RunLock(tmp_path).close()
    assert not path.exists()


@pytest.mark.parametrize("text", ["", '{"pid": 1', "[]", '{"pid": 1}'])
def test_what_says_nobody_is_nobodys(tmp_path: Path, text: str) -> None:
    (tmp_path / LOCK).write_text(text)
    RunLock(tmp_path).close()
    assert list(tmp_path.iterdir()) == []


def test_folders_made_for_nothing_are_removed_and_others_are_not(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    RunLock(tmp_path / "there/results/run").close()
    assert list((tmp_path / "there").iterdir()) == []
    lock = RunLock(tmp_path / "there/results/run")
    (tmp_path / "there/results/run/status.json").touch()
    lock.close()
    assert os.listdir(tmp_path / "there/results/run") == ["status.json"]


@pytest.mark.parametrize("error", [FileExistsError, FileNotFoundError])
def test_a_folder_that_went_while_it_was_made_is_made_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: type[OSError]
) -> None:
    mkdir, tries = Path.mkdir, []

    def interrupted(folder: Path, **options: bool) -> None:
        tries.append(folder)
        if len(tries) <= 2:
            raise error(folder)
        mkdir(folder, **options)

    monkeypatch.setattr(Path, "mkdir", interrupted)
    RunLock(tmp_path / "run").close()
    assert len(tries) == 3


def test_a_folder_that_can_never_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "run").touch()
    with pytest.raises(FileExistsError, match="run"):
        RunLock(tmp_path / "run")


def test_who_asks_just_then_whether_it_is_held_is_no_holder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    lockf, tries = fcntl.lockf, []

    def asked(descriptor: int, operation: int) -> None:
        tries.append(operation)
        if len(tries) <= 2:
            raise BlockingIOError
        lockf(descriptor, operation)

    monkeypatch.setattr("trainers.saving.run_lock.fcntl.lockf", asked)
    RunLock(tmp_path / "run").close()
    assert len(tries) == 3


def test_a_lock_that_became_anothers_is_left_to_it(tmp_path: Path) -> None:
    lock = RunLock(tmp_path)
    (tmp_path / LOCK).unlink()
    (tmp_path / LOCK).write_text("another's")
    lock.close()
    assert (tmp_path / LOCK).read_text() == "another's"


def taken(directory: Path) -> RunLock:
    """The lock, as soon as nobody else has it."""
    while True:
        try:
            return RunLock(directory)
        except UserError:
            pass


def contend(directory: Path, times: int) -> None:
    """Takes the lock so often, and fails where it is not alone in the folder."""
    inside = directory / "inside"
    for _ in range(times):
        lock = taken(directory)
        os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
        os.sched_yield()
        inside.unlink()
        lock.close()


def test_of_many_processes_one_at_a_time_is_in_the_folder(tmp_path: Path) -> None:
    children = []
    for _ in range(3):
        child = os.fork()
        if child == 0:
            try:
                contend(tmp_path / "results/run", 100)
                os._exit(0)
            finally:  # never back into pytest
                os._exit(1)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0, 0]
    # Empty folders may stay where one process came into what another had made.
    assert [path for path in tmp_path.rglob("*") if not path.is_dir()] == []
