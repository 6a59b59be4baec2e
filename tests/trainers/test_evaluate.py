"""Evaluation's command line: figures, the physical check, and pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from envs.grasp.evaluation.report import GraspReport
from trainers import evaluation
from trainers.common.errors import UserError
from trainers.evaluate import main
from trainers.runfile.registry import Registries
from trainers.saving.evaluation_folder import REPORT, EvaluationFolder

GRASP: dict[str, Any] = {
    "type": "grasp",
    "simulator": "fast",
    "num_envs": 4,
    "cameras": {"depth": {"type": "depth", "width": 32, "height": 32}},
}
PICTURES = set(GraspReport.file_names)


@pytest.fixture
def evaluate(
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> Callable[..., tuple[int, str, Path]]:
    """Trains a little and evaluates that; returns the exit code, the errors and the results."""
    monkeypatch.setattr(evaluation, "load_registries", lambda: registries)

    def run(environment: Any, *arguments: Any) -> tuple[int, str, Path]:
        learned = learn(write_run(environment))
        assert learned.code == 0, learned.errors
        results = learned.results
        report = results / "report.json"
        capfd.readouterr()
        code = main(
            [str(results / "toy"), "--episodes", "6", "--json", str(report), *map(str, arguments)]
        )
        return code, capfd.readouterr().err, results

    return run


def test_an_environment_without_measures_is_evaluated_by_its_rewards(
    evaluate: Callable[..., Any],
) -> None:
    code, _, results = evaluate("target")
    assert code == 0
    report = json.loads((results / "report.json").read_text())
    assert report["episodes"] == 6
    assert "pick_rate" not in report


@pytest.mark.parametrize("option", ["--pick", "--window", "--render"])
def test_what_an_environment_can_not_show_is_told(
    evaluate: Callable[..., Any], option: str
) -> None:
    code, errors, results = evaluate("target", option)
    assert code == 2
    assert ("--pick: " if option == "--window" else f"{option}: ") in errors
    assert "Traceback" not in errors
    assert not (results / "toy" / "evaluation").exists()


def test_picks_are_counted_and_drawn(evaluate: Callable[..., Any]) -> None:
    code, _, results = evaluate(GRASP, "--pick", "--render")
    assert code == 0
    report = json.loads((results / "report.json").read_text())
    assert set(report["pick_failures"]) == {"collision", "missed", "no_seal", "dropped"}
    assert report["pick_rate"] + sum(report["pick_failures"].values()) == pytest.approx(1.0)
    folder = results / "toy" / "evaluation"
    assert {path.name for path in folder.iterdir()} == {REPORT, *PICTURES}
    beside = json.loads((folder / REPORT).read_text())
    assert set(beside.pop("files")) == PICTURES
    assert beside == report


def test_a_window_needs_a_display(
    evaluate: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    code, errors, _ = evaluate(GRASP, "--window")
    assert code == 2
    assert "no window can be opened" in errors


class TestGallery:
    def write(self, folder: Path, content: bytes) -> None:
        EvaluationFolder(folder, ["a.png"]).write({"success": 0.5}, [("a.png", content)])

    def test_replaces_what_an_evaluation_left(self, tmp_path: Path) -> None:
        for content in (b"first", b"second"):
            self.write(tmp_path / "new" / "folder", content)
        assert (tmp_path / "new" / "folder" / "a.png").read_bytes() == b"second"

    @pytest.mark.parametrize(
        ("name", "content"),
        [("a.png", "mine"), (REPORT, "mine"), (REPORT, '{"success": 1}'), (REPORT, "[]")],
    )
    def test_leaves_alone_what_is_not_its_own(
        self, tmp_path: Path, name: str, content: str
    ) -> None:
        (tmp_path / name).write_text(content)
        with pytest.raises(UserError, match="choose another folder"):
            self.write(tmp_path, b"new")
        assert (tmp_path / name).read_text() == content
        assert len(list(tmp_path.iterdir())) == 1

    def test_other_files_do_not_matter(self, tmp_path: Path) -> None:
        (tmp_path / "notes.txt").write_text("mine")
        self.write(tmp_path, b"new")
        assert (tmp_path / "notes.txt").read_text() == "mine"

    def test_a_file_where_the_folder_should_be_is_told(self, tmp_path: Path) -> None:
        (tmp_path / "taken").write_text("mine")
        with pytest.raises(UserError, match=r"--render: .*taken"):
            self.write(tmp_path / "taken", b"new")
