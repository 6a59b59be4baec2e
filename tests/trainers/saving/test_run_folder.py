"""A run's folder, and how checkpoints are found by name."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from trainers.common.errors import UserError
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings, dump_yaml, load_run
from trainers.saving.checkpoint import Checkpoints
from trainers.saving.evaluation_folder import EvaluationFolder
from trainers.saving.run_folder import (
    CONFIGURATION,
    begin,
    claim,
    find_checkpoint,
    find_run_folder,
    has_checkpoints,
    run_folder,
    run_name,
)
from trainers.saving.run_lock import LOCK


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
    files = {CONFIGURATION: "first"}
    begin(tmp_path / "run", files, resume=False)
    save(tmp_path / "run", 1)
    begin(tmp_path / "run", {CONFIGURATION: "second"}, resume=True)
    assert (tmp_path / "run" / CONFIGURATION).read_text() == "second"
    assert has_checkpoints(tmp_path / "run")
    begin(tmp_path / "run", files, resume=False)
    assert not has_checkpoints(tmp_path / "run")


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def claim_and_give_up(directory: Path, *, resume: bool = False, force: bool = False) -> None:
    claim(directory, resume=resume, force=force).close()


def test_a_free_folder_will_do(tmp_path: Path) -> None:
    claim_and_give_up(tmp_path / "new")
    (tmp_path / "empty").mkdir()
    claim_and_give_up(tmp_path / "empty")
    (tmp_path / "empty" / LOCK).touch()  # of a process that was killed
    claim_and_give_up(tmp_path / "empty")
    assert names(tmp_path) == ["empty"]


def test_a_claimed_folder_says_by_whom(tmp_path: Path) -> None:
    lock = claim(tmp_path / "run", resume=False, force=False)
    assert f'"pid":{os.getpid()},' in (tmp_path / "run" / LOCK).read_text()
    begin(tmp_path / "run", {"a.txt": "kept"}, resume=False)
    lock.close()
    assert names(tmp_path) == ["run", "run/a.txt"]


def test_a_taken_folder_names_the_ways_out(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"--resume.*--force.*--run-id"):
        claim_and_give_up(tmp_path)
    with pytest.raises(UserError, match=r"notes\.txt: no run wrote this.*another --run-id"):
        claim_and_give_up(tmp_path, force=True)
    with pytest.raises(UserError, match="no checkpoint to resume; start the run without --resume"):
        claim_and_give_up(tmp_path, resume=True)
    assert names(tmp_path) == ["notes.txt"]
    (tmp_path / "notes.txt").rename(tmp_path / "configuration.yaml")
    claim_and_give_up(tmp_path, force=True)
    save(tmp_path, 1)
    claim_and_give_up(tmp_path, resume=True)


def a_run(folder: Path) -> None:
    """All that a run may leave, also one that was killed, and an evaluation of it."""
    save(folder, 1, 1.0)
    save(folder, 2, 2.0)
    for name in (".step-3.tmp-0a1b2c3d", ".step-2.old-0a1b2c3d"):
        (folder / "checkpoints" / name).mkdir()
    files = ["configuration.yaml", "policy.json", "status.json", "timers.json"]
    files += ["events.out.tfevents.1.host.2.0", ".status.json.tmp", "checkpoints/.best.json.tmp"]
    for file in files:
        (folder / file).touch()
    EvaluationFolder(folder / "evaluation", ["a.png"]).write({}, [("a.png", b"")])
    (folder / "evaluation/.a.png.tmp").touch()  # of an evaluation that was killed


def test_what_a_run_left_is_replaced_whole(tmp_path: Path) -> None:
    a_run(tmp_path / "run")
    lock = claim(tmp_path / "run", resume=False, force=True)
    begin(tmp_path / "run", {"a.txt": "new"}, resume=False)
    assert names(tmp_path / "run") == ["a.txt", LOCK]
    lock.close()


def test_an_evaluation_that_was_killed_at_once_is_replaced(tmp_path: Path) -> None:
    a_run(tmp_path)
    for path in (tmp_path / "evaluation").iterdir():
        path.unlink()
    (tmp_path / "evaluation/.evaluation.json.tmp").touch()
    claim_and_give_up(tmp_path, force=True)


@pytest.mark.parametrize(
    "foreign",
    [
        "notes.txt",
        "photos/holiday.jpg",
        "checkpoints/step-best",
        "checkpoints/notes.txt",
        "evaluation/notes.txt",
        "my-status.json",
        "manifest.json",
    ],
)
def test_what_no_run_wrote_keeps_a_folder_from_being_replaced(tmp_path: Path, foreign: str) -> None:
    a_run(tmp_path)
    (tmp_path / foreign).parent.mkdir(exist_ok=True)
    (tmp_path / foreign).write_text("mine")
    before = names(tmp_path)
    said = rf"{tmp_path / foreign.split('/h', maxsplit=1)[0]}: no run wrote this"
    with pytest.raises(UserError, match=said):
        claim_and_give_up(tmp_path, force=True)
    with pytest.raises(UserError, match=said):  # it may have come since
        begin(tmp_path, {"a.txt": "new"}, resume=False)
    assert names(tmp_path) == before


def test_links_are_not_followed_when_a_run_is_replaced(tmp_path: Path) -> None:
    a_run(tmp_path / "run")
    (tmp_path / "run/checkpoints").rename(tmp_path / "elsewhere")
    (tmp_path / "run/checkpoints").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="run/checkpoints: no run wrote this"):
        claim_and_give_up(tmp_path / "run", force=True)
    assert (tmp_path / "elsewhere/step-1/manifest.json").is_file()


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "../one", "a/b", "/a", "a\\b", "a\nb"])
def test_a_path_is_no_name(name: str) -> None:
    with pytest.raises(UserError, match=r"--run-id .*: a run's name is that of a folder"):
        run_name(name)


@pytest.mark.parametrize("name", ["toy", "toy-2", "lr=3e-4, seed 1", "café", "v1..2"])
def test_any_other_name_is(name: str) -> None:
    assert run_name(name) == name


def test_an_only_checkpoint_between_two_renames_can_be_resumed_as_it_can_be_evaluated(
    tmp_path: Path,
) -> None:
    save(tmp_path, 100).rename(tmp_path / "checkpoints/.step-100.old-0a1b2c3d")
    claim_and_give_up(tmp_path, resume=True)
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
