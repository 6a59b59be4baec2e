"""What is read of a run's folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from trainers.common.errors import UserError
from trainers.comparison import results
from trainers.comparison.results import REWARD, SPEED, Curves, RunResult, read_run, read_status
from trainers.reporting.event_log import RunLog
from trainers.saving.run_folder import CONFIGURATION


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    log = RunLog(tmp_path)
    for step, reward in ((100, 1.0), (200, 3.0), (400, 2.0)):
        log.scalars({REWARD: reward, SPEED: 50.0}, step)
    log.status({"state": "finished", "step": 400, "evaluation": {"success": 0.5}})
    log.close()
    (tmp_path / CONFIGURATION).write_text("seed: 7\ntrainer: {trainer_type: ppo}\n")
    return tmp_path


def test_a_run_by_hand(folder: Path) -> None:
    run = read_run(folder)
    assert (run.seed, run.step, run.evaluation) == (7, 400, {"success": 0.5})
    np.testing.assert_array_equal(run.reward[0], [100, 200, 400])
    np.testing.assert_array_equal(run.reward[1], [1.0, 3.0, 2.0])
    assert run.seconds == pytest.approx(400 / 50.0)


def test_what_a_run_that_was_cut_off_logged_beyond_its_checkpoint_is_not_counted(
    folder: Path,
) -> None:
    log = RunLog(folder, resumed_at=200)
    log.scalars({REWARD: 9.0, SPEED: 25.0}, 300)
    log.close()
    run = read_run(folder)
    np.testing.assert_array_equal(run.reward[0], [100, 200, 300])
    np.testing.assert_array_equal(run.reward[1], [1.0, 3.0, 9.0])
    assert run.seconds == pytest.approx(200 / 50.0 + 100 / 25.0)


def test_an_event_file_that_was_cut_short_has_what_is_before_the_cut(folder: Path) -> None:
    (events,) = folder.glob("events.out.*")
    content = events.read_bytes()
    events.write_bytes(content[:-30])
    steps, values = read_run(folder).reward
    assert 1 <= len(steps) <= 3
    np.testing.assert_array_equal(values, [1.0, 3.0, 2.0][: len(steps)])


def test_a_run_that_has_hardly_begun_is_one(tmp_path: Path) -> None:
    (tmp_path / CONFIGURATION).write_text("trainer: {trainer_type: ppo}\n")
    run = read_run(tmp_path)
    assert (run.seed, run.step, run.seconds, dict(run.evaluation)) == (0, 0, 0.0, {})
    assert not len(run.reward[0])


@pytest.mark.parametrize(
    ("status", "message"),
    [("{", r"status\.json: can't be read: "), (json.dumps([1]), "should be an object")],
)
def test_a_damaged_status_is_named(folder: Path, status: str, message: str) -> None:
    (folder / "status.json").write_text(status)
    with pytest.raises(UserError, match=message):
        read_run(folder)


@pytest.mark.parametrize(
    ("state", "held", "said"),
    [
        ("running", True, ("running", None)),
        ("running", False, ("interrupted", "its process was killed")),
        ("finished", False, ("finished", None)),
    ],
)
def test_a_run_goes_on_as_long_as_a_process_writes_into_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, state: str, held: bool, said: tuple[str, str]
) -> None:
    monkeypatch.setattr(results, "is_held", lambda directory: held and directory == folder)
    (folder / "status.json").write_text(json.dumps({"state": state, "step": 3}))
    status = read_status(folder)
    assert (status["state"], status.get("reason")) == said
    assert status["step"] == 3


def test_a_run_that_ends_between_two_looks_has_ended(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ends(directory: Path) -> bool:
        (directory / "status.json").write_text('{"state": "finished", "step": 4}')
        return False

    monkeypatch.setattr(results, "is_held", ends)
    (folder / "status.json").write_text('{"state": "running", "step": 3}')
    assert read_status(folder)["state"] == "finished"


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"this is no run: it has no configuration\.yaml"):
        read_run(tmp_path)


def test_without_an_evaluation_there_is_none() -> None:
    assert RunResult(Path(), {}, {"evaluation": None}).evaluation == {}


def test_curves_of_a_run_that_goes_on_grow(tmp_path: Path) -> None:
    log = RunLog(tmp_path)
    curves = Curves(tmp_path)
    assert curves.tags == []
    for step in (10, 20):
        log.scalars({"a": step / 10.0}, step)
        curves.reload()
        assert curves.curve("a")[0].tolist() == list(range(10, step + 1, 10))
    log.close()
    # Taken up from step 10, in another file.
    log = RunLog(tmp_path, resumed_at=10)
    log.scalars({"a": 5.0}, 20)
    log.close()
    curves.reload()
    assert [part.tolist() for part in curves.curve("a")] == [[10, 20], [1.0, 5.0]]
