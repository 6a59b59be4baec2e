"""Optuna's part of a sweep."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from optuna.storages import RDBStorage
from sqlalchemy.exc import OperationalError

from trainers.common.errors import UserError
from trainers.runfile.registry import Registries
from trainers.sweep import study as study_module
from trainers.sweep.plan import load_sweep
from trainers.sweep.study import distributions, open_study, shown_storage

RATE, BATCH = "trainer.hyperparameters.learning_rate", "trainer.hyperparameters.batch_size"
GRID = {RATE: {"choice": [1e-3, 1e-2]}, BATCH: {"choice": [16, 32]}}


def params_of(sweep: Any, storage: Path, count: int) -> list[dict[str, Any]]:
    """Values of the next so many trials of a process that begins now."""
    study = open_study(sweep, str(storage))
    found = []
    for _ in range(count):
        trial = study.ask(distributions(sweep))
        found.append(trial.params)
        study.tell(trial, trial.params[BATCH] - trial.params[RATE])
    return found


@pytest.mark.parametrize("sampler", ["random", "tpe"])
def test_what_is_drawn_depends_on_the_trials_number_and_not_on_its_process(
    sampler: str, sweep_file: Callable[..., Path], known: Registries, tmp_path: Path
) -> None:
    sweep = load_sweep(sweep_file(sampler=sampler), known)
    whole = params_of(sweep, tmp_path / "whole.journal", 14)
    # Beyond the first ten, TPE draws by what became of the others.
    parts = [params_of(sweep, tmp_path / "parts.journal", count) for count in (3, 9, 2)]
    assert [values for part in parts for values in part] == whole
    assert len({values[RATE] for values in whole}) == 14
    ranks = [sorted(values[RATE] for values in whole).index(values[RATE]) for values in whole]
    assert {values[BATCH] for values in whole} == {16, 32}
    assert ranks != sorted(ranks)


def test_processes_that_ask_together_share_a_grid(
    sweep_file: Callable[..., Path], known: Registries, tmp_path: Path
) -> None:
    sweep = load_sweep(sweep_file(sampler="grid", space=GRID), known)
    studies = [open_study(sweep, str(tmp_path / "journal")) for _ in range(2)]
    asked = [study.ask(distributions(sweep)) for _ in range(2) for study in studies]
    assert [trial.params for trial in asked] == sweep.cells


def test_the_journals_lock_leads_to_it_from_its_own_folder(
    sweep_file: Callable[..., Path],
    known: Registries,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    symlink, made = os.symlink, []

    def seen(target: str, link: str) -> None:
        symlink(target, link)
        made.append(Path(link).exists())

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "symlink", seen)
    open_study(load_sweep(sweep_file(), known), "results/journal")
    assert made
    assert all(made)


def test_half_a_line_that_a_killed_process_left_is_cut_off(
    sweep_file: Callable[..., Path],
    known: Registries,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    sweep, path = load_sweep(sweep_file(sampler="random"), known), tmp_path / "a" / "journal"
    first = params_of(sweep, path, 3)
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"op_code": 6, "worker')
    second = params_of(sweep, path, 2)
    assert f"{path}: the last line was not written to its end, and is left out" in caplog.text
    assert path.read_bytes().startswith(whole + b'{"op_code":')
    trials = open_study(sweep, str(path)).trials
    assert [trial.params for trial in trials] == first + second
    assert not list(path.parent.glob("*.lock"))


def test_a_file_that_is_no_journal_is_refused_as_it_is(
    sweep_file: Callable[..., Path], known: Registries, tmp_path: Path
) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("mine\nthe last line has no end")
    with pytest.raises(UserError, match=r"notes.txt: can't be used: "):
        open_study(load_sweep(sweep_file(), known), str(path))
    assert path.read_text() == "mine\nthe last line has no end"


def test_a_database_whose_tables_another_process_makes_just_then_is_asked_again(
    sweep_file: Callable[..., Path],
    known: Registries,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tries = []

    def storage(url: str) -> RDBStorage:
        tries.append(url)
        if len(tries) == 1:
            raise OperationalError("CREATE TABLE studies", {}, Exception("it already exists"))
        return RDBStorage(url)

    monkeypatch.setattr(study_module, "RDBStorage", storage)
    monkeypatch.setattr(study_module, "DATABASE_PAUSE_S", 0.0)
    open_study(load_sweep(sweep_file(), known), f"sqlite:///{tmp_path}/study.db")
    assert len(tries) == 2


def test_a_sweep_of_the_same_name_is_refused_if_it_is_another(
    sweep_file: Callable[..., Path], known: Registries, tmp_path: Path
) -> None:
    storage = str(tmp_path / "journal")
    open_study(load_sweep(sweep_file(), known), storage)
    open_study(load_sweep(sweep_file(trials=50, pruner="none"), known), storage)
    other = load_sweep(sweep_file(fixed={"trainer.max_steps": 512}), known)
    with pytest.raises(UserError, match=r"another sweep .*'pole': run\.trainer\.max_steps differs"):
        open_study(other, storage)


@pytest.mark.parametrize(
    ("storage", "message"),
    [
        ("sqlite:////nowhere/at/all.db", "unable to open database file"),
        ("nosuch://user:secret@host/db", "Can't load plugin"),
        ("://", "Could not parse SQLAlchemy URL"),
        ("run.yaml/study.journal", "File exists"),
        ("run.yaml", "Expecting value"),
    ],
)
def test_storages_that_cannot_be_used_are_told_in_a_line(
    storage: str,
    message: str,
    sweep_file: Callable[..., Path],
    known: Registries,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sweep = load_sweep(sweep_file(), known)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"^--storage .*: can't be used: ") as caught:
        open_study(sweep, storage)
    said = str(caught.value)
    assert message in said
    assert "secret" not in said
    assert "\n" not in said


def test_a_password_is_not_shown() -> None:
    assert shown_storage("postgresql://me:secret@host/db") == "postgresql://me:***@host/db"
    assert shown_storage("a/file.journal") == "a/file.journal"
