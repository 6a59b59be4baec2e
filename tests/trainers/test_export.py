"""Exporting a policy: it is judged as its run is, and replaces nothing unasked."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trainers import evaluation
from trainers.common.command import DONE, MISTAKE
from trainers.common.errors import UserError
from trainers.deployment import exporting
from trainers.evaluation import evaluate
from trainers.export import main
from trainers.inference.policy import Policy


@pytest.fixture
def results(learned: Callable[..., Path]) -> Path:
    """The results of a run `toy`."""
    return learned("target")


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


def test_an_export_that_was_cut_off_is_no_policy(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = exporting.write_atomically

    def cut_off(path: Path, content: bytes | str) -> None:
        if path.name == "policy.json":
            raise KeyboardInterrupt
        write(path, content)

    monkeypatch.setattr(exporting, "write_atomically", cut_off)
    with pytest.raises(KeyboardInterrupt):
        exporting.export("toy", tmp_path / "mine", results)
    assert (tmp_path / "mine/weights.safetensors").exists()
    with pytest.raises(UserError, match="mine"):
        Policy.load(tmp_path / "mine")


@pytest.fixture
def darts(learned: Callable[..., Path]) -> Path:
    """The results of a run `toy` whose first actions are judged, and whose others are drawn."""
    return learned("darts")


def test_an_onnx_file_has_the_figures_of_its_run(
    darts: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert export(darts, tmp_path / "mine", "--format", "onnx") == DONE
    file = tmp_path / "mine" / "policy.onnx"
    said = capfd.readouterr().out.splitlines()
    assert said[0] == f"{file}: goal -> action, unbounded_action"
    assert said[1].startswith("largest difference to torch, on 4 observations of its environment: ")
    assert "on 96 observations drawn at random: action " in said[2]
    assert re.fullmatch(r"\d+\.\d\d ms an observation, on one thread \(median\)", said[3])
    assert len(said) == 4
    own = evaluate(str(file), episodes=8, seed=0).report
    expected = evaluate("toy", episodes=8, seed=0, results_dir=darts).report
    assert flat(own) == pytest.approx(flat(expected), abs=1e-5)

    assert export(darts, file) == MISTAKE
    assert f"{file.parent}: policy.onnx would be replaced" in capfd.readouterr().err
    assert main([str(file), str(tmp_path / "other"), "--results-dir", str(darts)]) == MISTAKE
    assert "neither a run nor a checkpoint" in capfd.readouterr().err
    changed = ["environment.episode_steps=1"]
    assert evaluate(str(file), episodes=8, overrides=changed).report["episode_length"] == 1


def flat(report: dict[str, Any]) -> dict[str, Any]:
    """Figures, those with parts by part."""
    return {
        f"{key}.{part}": number
        for key, value in report.items()
        for part, number in (value.items() if isinstance(value, dict) else [("", value)])
    }


def test_a_folder_has_no_camera(
    results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert export(results, tmp_path / "mine", "--unit", "5000") == MISTAKE
    assert "--camera and --unit are for --format onnx" in capfd.readouterr().err


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
    assert f"{results / 'mine' / 'manifest.json'}: no run wrote this" in learned.errors
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
