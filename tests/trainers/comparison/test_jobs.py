"""Runs that leave files of results."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainers.comparison.jobs import Job, run_missing

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
