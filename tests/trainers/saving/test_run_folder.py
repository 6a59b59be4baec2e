"""A run's folder, and how checkpoints are found by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from trainers.common.errors import UserError
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings, dump_yaml, load_run
from trainers.saving.checkpoint import Checkpoints
from trainers.saving.run_folder import (
    CONFIGURATION,
    begin,
    check,
    find_checkpoint,
    find_run_folder,
    has_checkpoints,
    run_folder,
)


def save(folder: Path, step: int, score: float | None = None) -> Path:
    weights = {"w": torch.tensor([float(step)])}
    return Checkpoints(folder / "checkpoints", keep=9).save(step, weights, {}, score)


def test_a_folder_begins_with_the_settings_that_reproduce_the_run(
    tmp_path: Path, make_run: Callable[..., RunSettings], registries: Registries
) -> None:
    run = make_run("target", environment_parameters={"scale": 2.0}, seed=7)
    begin(tmp_path / "deep/run", {CONFIGURATION: dump_yaml(run)}, resume=False)
    assert load_run(tmp_path / "deep/run/configuration.yaml", [], registries) == run


def test_beginning_afresh_replaces_and_resuming_keeps(
    tmp_path: Path,
) -> None:
    files = {"a.txt": "first"}
    begin(tmp_path / "run", files, resume=False)
    save(tmp_path / "run", 1)
    begin(tmp_path / "run", {"a.txt": "second"}, resume=True)
    assert (tmp_path / "run/a.txt").read_text() == "second"
    assert has_checkpoints(tmp_path / "run")
    begin(tmp_path / "run", files, resume=False)
    assert not has_checkpoints(tmp_path / "run")


def test_a_free_folder_will_do(tmp_path: Path) -> None:
    check(tmp_path / "new", resume=False, force=False)
    (tmp_path / "empty").mkdir()
    check(tmp_path / "empty", resume=False, force=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty"]


def test_a_taken_folder_names_the_ways_out(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"--resume.*--force.*--run-id"):
        check(tmp_path, resume=False, force=False)
    with pytest.raises(UserError, match=r"this is none \(it has no configuration\.yaml\)"):
        check(tmp_path, resume=False, force=True)
    with pytest.raises(UserError, match="no checkpoint to resume; start the run without --resume"):
        check(tmp_path, resume=True, force=False)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    (tmp_path / "configuration.yaml").touch()
    check(tmp_path, resume=False, force=True)
    save(tmp_path, 1)
    check(tmp_path, resume=True, force=False)


def test_an_only_checkpoint_between_two_renames_can_be_resumed_as_it_can_be_evaluated(
    tmp_path: Path,
) -> None:
    save(tmp_path, 100).rename(tmp_path / "checkpoints/.step-100.old-0a1b2c3d")
    check(tmp_path, resume=True, force=False)
    assert find_checkpoint(str(tmp_path), tmp_path).step == 100


def test_a_folder_that_can_not_be_made_is_the_users_mistake(
    tmp_path: Path, make_run: Callable[..., RunSettings]
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"file.*can't be written: .*--results-dir"):
        begin(tmp_path / "file/run", {}, resume=False)


def test_checkpoints_are_found_by_run_id_by_run_and_by_their_own_path(tmp_path: Path) -> None:
    run = tmp_path / "results/first"
    best, latest = save(run, 100, 2.0), save(run, 200, 1.0)
    (run / CONFIGURATION).touch()
    for name, step in (("first", 100), (str(run), 100), (str(best), 100), (str(latest), 200)):
        found = find_checkpoint(name, tmp_path / "results")
        assert found.step == step
        assert found.weights["w"].tolist() == [float(step)]
        assert found.state is None
        assert run_folder(found.path) == run
        assert find_run_folder(name, tmp_path / "results").resolve() == run


def test_a_checkpoint_that_was_moved_out_of_its_run_lacks_its_run_file(tmp_path: Path) -> None:
    moved = save(tmp_path / "results/first", 100, 2.0).rename(tmp_path / "moved")
    with pytest.raises(UserError, match=r"moved: its configuration\.yaml is not there.*left it"):
        run_folder(moved)


def test_a_name_that_leads_nowhere_is_the_users_mistake(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"^ghost: neither a run nor a checkpoint.*{tmp_path}"):
        find_checkpoint("ghost", tmp_path)
