"""Exporting a policy: it is judged as its run is, and replaces nothing unasked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trainers import evaluation
from trainers.evaluation import evaluate
from trainers.export import main
from trainers.learn import DONE, MISTAKE
from trainers.runfile.registry import Registries


@pytest.fixture
def results(
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """The results of a run `toy`."""
    monkeypatch.setattr(evaluation, "load_registries", lambda: registries)
    learned = learn(write_run("target"))
    assert learned.code == DONE, learned.errors
    found: Path = learned.results
    return found


def export(results: Path, folder: Path, *options: str) -> int:
    return main(["toy", str(folder), "--results-dir", str(results), *options])


def test_an_exported_policy_has_the_figures_of_its_run(results: Path, tmp_path: Path) -> None:
    folder = tmp_path / "policies" / "mine"
    assert export(results, folder) == DONE
    assert {file.name for file in folder.iterdir()} == {
        "weights.safetensors",
        "manifest.json",
        "configuration.yaml",
        "policy.json",
    }
    own = evaluate(str(folder), episodes=8, seed=0)
    assert own == evaluate("toy", episodes=8, seed=0, results_dir=results)


def test_a_run_can_begin_with_an_exported_policy(
    results: Path, tmp_path: Path, learn: Callable[..., Any], write_run: Callable[..., Path]
) -> None:
    assert export(results, tmp_path / "mine") == DONE
    options = ["--run-id", "second", "--initialize-from", str(tmp_path / "mine")]
    assert learn(write_run("target"), *options).code == DONE


def test_nothing_is_replaced_unasked(
    results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "configuration.yaml").write_text("mine")
    assert export(results, folder) == MISTAKE
    assert f"{folder}: configuration.yaml would be replaced" in capfd.readouterr().err
    assert [file.name for file in folder.iterdir()] == ["configuration.yaml"]
    assert export(results, folder, "--force") == DONE
    assert (folder / "configuration.yaml").read_text() != "mine"


def test_runs_and_policies_do_not_replace_each_other(
    results: Path,
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert export(results, results / "toy", "--force") == MISTAKE
    assert "this is a run" in capfd.readouterr().err
    assert export(results, results / "mine") == DONE
    learned = learn(write_run("target"), "--run-id", "mine", "--force")
    assert learned.code == MISTAKE
    assert "this is an exported policy" in learned.errors
    assert (results / "mine" / "weights.safetensors").is_file()


def test_damaged_weights_are_named(results: Path, tmp_path: Path) -> None:
    assert export(results, tmp_path / "mine") == DONE
    weights = tmp_path / "mine" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"!")
    with pytest.raises(evaluation.UserError, match=r"weights\.safetensors .*checksum"):
        evaluate(str(tmp_path / "mine"), episodes=8, seed=0)


def test_what_can_not_be_exported_is_the_users_mistake(
    results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["nothing", str(tmp_path / "mine"), "--results-dir", str(results)]) == MISTAKE
    assert "nothing: neither a run nor a checkpoint" in capfd.readouterr().err
    (tmp_path / "file").touch()
    assert export(results, tmp_path / "file" / "mine") == MISTAKE
    assert "can't be written" in capfd.readouterr().err
