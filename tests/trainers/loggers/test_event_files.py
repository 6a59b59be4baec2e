"""What a run logged after its last checkpoint is not in its files twice."""

from __future__ import annotations

from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from trainers.loggers.event_files import PATTERN, cut_after
from trainers.reporting.event_log import RunLog


def logged(directory: Path) -> list[tuple[str, int]]:
    """Tags and steps of all points in all files, as they stand there, by step."""
    found = [
        (value.tag, event.step)
        for path in directory.glob(PATTERN)
        for event in EventFileLoader(str(path)).Load()
        for value in event.summary.value
    ]
    return sorted(found, key=lambda point: point[1])


def log(directory: Path, *steps: int, resumed_at: int | None = None) -> None:
    run_log = RunLog(directory, resumed_at)
    run_log.text("configuration", "of the run", resumed_at or 0)
    for step in steps:
        run_log.scalars({"reward": 0.0, "loss": 1.0}, step)
    run_log.close()


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    log(tmp_path, 100, 200, 300)
    return tmp_path


def test_points_of_later_steps_are_logged_once(directory: Path) -> None:
    log(directory, 300, 400, resumed_at=200)
    log(directory, 300, 400, resumed_at=200)
    log(directory, 400, 500, resumed_at=300)
    found = logged(directory)
    assert len(set(found)) == len(found)
    assert [step for tag, step in found if tag == "loss"] == [100, 200, 300, 400, 500]


def test_files_without_later_points_are_left_alone(directory: Path) -> None:
    (path,) = directory.glob(PATTERN)
    before = path.read_bytes()
    cut_after(directory, 300)
    assert path.read_bytes() == before


@pytest.mark.parametrize("missing", [1, 4, 5, 30])
def test_a_record_cut_short_goes(directory: Path, missing: int) -> None:
    (path,) = directory.glob(PATTERN)
    path.write_bytes(path.read_bytes()[:-missing])
    log(directory, 300, resumed_at=250)
    assert [step for tag, step in logged(directory) if tag == "loss"] == [100, 200, 300]


def test_what_follows_a_damaged_record_goes(directory: Path) -> None:
    (path,) = directory.glob(PATTERN)
    end = path.stat().st_size
    path.write_bytes(path.read_bytes() + b"\xff" * 40)
    cut_after(directory, 300)
    assert path.stat().st_size == end
