"""Runs that leave files of results."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from trainers.comparison import jobs
from trainers.comparison.jobs import Job, run, run_missing

APPEND = "import os, sys; open(sys.argv[1], 'a').write(sys.argv[2] + os.environ['OMP_NUM_THREADS'])"


def append(path: Path, *texts: str) -> Job:
    return Job(path.stem, [["-c", APPEND, str(path), text] for text in texts], path)


def test_commands_follow_each_other_with_a_thread_each(tmp_path: Path) -> None:
    first, second = tmp_path / "new" / "first.json", tmp_path / "new" / "second.json"
    assert run_missing([append(first, "a", "b"), append(second, "c")], at_once=2) == 0
    assert (first.read_text(), second.read_text()) == ("a1b1", "c1")


def test_what_is_there_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "done.json").write_text("results")
    assert run_missing([append(tmp_path / "done.json", "a")], at_once=1) == 0
    assert (tmp_path / "done.json").read_text() == "results"
    assert not capsys.readouterr().out


def test_a_failure_is_told_and_ends_the_job(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    never = tmp_path / "never.json"
    failing = ["-c", "import sys; print('the reason', file=sys.stderr); sys.exit(3)"]
    job = Job("broken", [failing, *append(never, "a").commands], never)
    assert run_missing([job, append(tmp_path / "other.json", "b")], at_once=1) == 3
    assert "broken failed:\nthe reason" in capsys.readouterr().err
    assert not never.exists()
    assert (tmp_path / "other.json").exists()


def test_lines_of_jobs_side_by_side_are_not_torn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes: list[str] = []
    monkeypatch.setattr("sys.stdout.write", writes.append)
    run_missing([append(tmp_path / "first.json", "a")], at_once=1)
    assert writes == ["first begins\n"]


SAVES = """
import os, signal, sys, time
def save(number, frame):
    open(sys.argv[1], "w").close()
    os._exit(143)
signal.signal(signal.SIGTERM, save)
open(sys.argv[2], "w").close()
time.sleep(60)
"""


def test_a_job_that_is_to_stop_is_told_and_saves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(jobs, "POLL_S", 0.02)
    saved, ready = tmp_path / "saved", tmp_path / "ready"
    job = Job("long", [["-c", SAVES, str(saved), str(ready)]], saved, stop=ready.exists)
    assert run(job).code == 143
    assert saved.exists()
    assert not capsys.readouterr().err


def test_signals_of_the_terminal_reach_only_jobs_that_nobody_else_stops(tmp_path: Path) -> None:
    own = tmp_path / "own"
    say = ["-c", f"import os; open({str(own)!r}, 'w').write(str(os.getpgid(0)))"]
    for stop, alone in ((None, False), (lambda: False, True)):
        assert run(Job("group", [say], own, stop=stop)).code == 0
        assert (int(own.read_text()) != os.getpgid(0)) is alone


def test_no_job_begins_after_the_stop(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    jobs = [append(first, "a"), append(second, "b")]
    assert run_missing(jobs, at_once=1, stop=first.exists) == 143
    assert not second.exists()


def test_a_job_whose_watching_fails_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "POLL_S", 0.02)
    saved, ready = tmp_path / "saved", tmp_path / "ready"

    def stop() -> bool:
        if ready.exists():
            raise ConnectionError("lost")
        return False

    job = Job("long", [["-c", SAVES, str(saved), str(ready)]], saved, stop=stop)
    with pytest.raises(ConnectionError):
        run(job)
    for _ in range(500):
        time.sleep(0.0 if saved.exists() else 0.02)
    assert saved.exists()


def test_a_job_that_a_signal_ended_has_the_exit_code_that_shells_give(tmp_path: Path) -> None:
    kill = ["-c", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"]
    killed = Job("killed", [kill], tmp_path / "none")
    assert run_missing([killed, append(tmp_path / "other", "b")], at_once=1) == 137
