"""Evaluation's command line: figures, the physical check, and pictures."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from envs.environment import EnvironmentFailure
from envs.evaluation import PhysicalCheckOption
from envs.grasp.evaluation.report import GraspReport
from trainers import evaluation
from trainers.common.errors import NonFiniteError, UserError
from trainers.evaluate import main
from trainers.runfile.registry import Registries
from trainers.saving.evaluation_folder import REPORT, EvaluationFolder
from trainers.saving.run_folder import find_checkpoint

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
        held_out = {"interval": 16, "episodes": 4}
        learned = learn(write_run(environment, evaluation=held_out), "--force")
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


def test_figures_are_printed_for_programs(
    evaluate: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    code, _, results = evaluate("target")
    assert code == 0
    assert main([str(results / "toy"), "--episodes", "6", "--json", "-"]) == 0
    assert json.loads(capfd.readouterr().out) == json.loads((results / "report.json").read_text())


def test_what_an_environment_can_not_show_is_told(evaluate: Callable[..., Any]) -> None:
    code, errors, results = evaluate("target", "--render")
    assert code == 2
    assert errors == "error: --render: the environment has no pictures to show\n"
    assert not (results / "toy" / "evaluation").exists()


@pytest.mark.parametrize(
    ("option", "value", "limits"),
    [
        ("--episodes", "0", "1 to"),
        ("--episodes", "x", "1 to"),
        ("--seed", "-1", "0 to"),
        ("--seed", str(2**31), f"0 to {2**31 - 1}"),
    ],
)
def test_counts_and_seeds_are_whole_numbers_within_limits(
    capsys: pytest.CaptureFixture[str], option: str, value: str, limits: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["policies/grasp", option, value])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert f"{option}: should be a whole number from {limits}" in said
    assert f"not '{value}'" in said


def test_a_key_is_not_taken_for_the_folder_of_pictures(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["policies/grasp", "--render", "environment.num_envs=2"])
    assert stop.value.code == 2
    said = "environment.num_envs=2 is taken for its DIR: write it before --render"
    assert said in capsys.readouterr().err


def test_nothing_but_the_policy_is_required(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().err.endswith("are required: policy\n")


def test_a_plugin_that_is_not_installed_is_named_with_its_distribution(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "theirs"
    shutil.copytree(Path(__file__).parents[2] / "policies" / "grasp", folder)
    path = folder / "policy.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "trainer": {"name": "sac", "distribution": "theirs"}}))
    assert main([str(folder)]) == 2
    assert "needs the trainer 'sac' of theirs, which is not installed" in capsys.readouterr().err


class TestAThirdPartysEnvironment:
    """Its figures, check, pictures and options are its own affair: darts, in conftest.py."""

    def test_has_its_figures_in_the_report_and_in_the_table(
        self, evaluate: Callable[..., Any], capfd: pytest.CaptureFixture[str]
    ) -> None:
        code, _, results = evaluate("darts")
        assert code == 0
        assert main([str(results / "toy"), "--episodes", "6"]) == 0
        printed = capfd.readouterr().out
        report = json.loads((results / "report.json").read_text())
        assert list(report) == [
            *("episodes", "seed", "success", "inside_rate", "reward", "reward_std"),
            *("episode_length", "first_action_success", "first_action_inside_rate", "distance_m"),
        ]
        assert set(report["distance_m"]) == {"median", "p95"}
        for row in (
            f"darts on the board {report['inside_rate']:.1%} higher",
            f"first action darts on the board {report['first_action_inside_rate']:.1%} higher",
            f"distance, median {report['distance_m']['median'] * 100:.2f} cm lower",
            f"distance, p95 {report['distance_m']['p95'] * 100:.2f} cm lower",
        ):
            assert row in " ".join(printed.replace("│", " ").split())

    def test_has_a_best_checkpoint_and_is_judged_by_it(self, evaluate: Callable[..., Any]) -> None:
        code, _, results = evaluate("darts")
        assert code == 0
        best = json.loads((results / "toy" / "checkpoints" / "best.json").read_text())
        found = find_checkpoint("toy", results)
        assert found.path.name == best["checkpoint"]
        assert 0.0 <= best["score"] <= 1.0  # the success rate, or that of the first action

    def test_is_checked_and_drawn(self, evaluate: Callable[..., Any]) -> None:
        code, _, results = evaluate("darts", "--throw", "--render")
        assert code == 0
        report = json.loads((results / "report.json").read_text())
        assert set(report["throw_failures"]) == {"fell_off"}
        assert report["throw_rate"] + report["throw_failures"]["fell_off"] == 1.0
        stuck = round(6 * report["throw_rate"])
        folder = results / "toy" / "evaluation"
        assert (folder / "board.txt").read_text() == f"{stuck} of 6"

    def test_can_refuse_to_be_watched(self, evaluate: Callable[..., Any]) -> None:
        code, errors, _ = evaluate("darts", "--watch")
        assert code == 2
        assert errors == "error: the throw: it is too dark to see anything\n"

    def test_has_options_that_stand_for_keys_of_the_run_file(
        self, evaluate: Callable[..., Any]
    ) -> None:
        lengths = []
        for arguments in ((), ("--darts", "3"), ("environment.episode_steps=5",)):
            code, errors, results = evaluate("darts", *arguments)
            assert code == 0, errors
            report = json.loads((results / "report.json").read_text())
            lengths.append(report["episode_length"])
        assert lengths == [4.0, 3.0, 5.0]


def test_help_lists_the_environments_own_options(
    evaluate: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as leaving:
        evaluate("darts", "--help")
    assert leaving.value.code == 0
    told = capfd.readouterr().out
    for text in ("'darts'", "--darts VALUE", "100% of them", "--throw", "--watch", "KEY=VALUE"):
        assert text in told
    with pytest.raises(SystemExit):
        main(["--help"])
    told = capfd.readouterr().out
    assert "--throw" not in told
    assert "--render" in told


@pytest.mark.parametrize(
    ("environment", "option", "told"),
    [
        ("darts", "--thow", "unknown option --thow; did you mean '--throw'?"),
        ("darts", "--dart5=3", "unknown option --dart5; did you mean '--darts'?"),
        ("target", "--throw", "unknown option --throw; known: --episodes, --help, --json"),
        ("target", "--results_dir=x", "unknown option --results_dir; did you mean '--results-dir'"),
        ("target", "environment.episode_step=3", "did you mean 'episode_steps'?"),
        ("target", "nonsense", "KEY=VALUE"),
    ],
)
def test_an_unknown_option_names_the_nearest(
    evaluate: Callable[..., Any], environment: str, option: str, told: str
) -> None:
    code, errors, _ = evaluate(environment, option)
    assert code == 2
    assert told in errors
    assert "Traceback" not in errors


def test_an_option_may_come_before_the_policy(evaluate: Callable[..., Any], tmp_path: Path) -> None:
    _, _, results = evaluate("darts")
    report = tmp_path / "other.json"
    assert main(["--seed", "1", "--json", str(report), str(results / "toy"), "--throw"]) == 0
    assert "throw_rate" in json.loads(report.read_text())


def test_an_option_that_there_is_already_is_the_environments_mistake(
    evaluate: Callable[..., Any], registries: Registries, monkeypatch: pytest.MonkeyPatch
) -> None:
    clash = (PhysicalCheckOption("--seed", "of a plant"),)
    monkeypatch.setattr(registries.environments.get("darts").cls, "evaluation_options", clash)
    code, errors, _ = evaluate("darts")
    assert code == 2
    assert "'darts' offers an option that there is already: --seed" in errors


def test_an_option_with_a_value_before_the_policy_is_told_where_it_belongs(
    evaluate: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    _, _, results = evaluate("darts")
    assert main(["--darts", "3", str(results / "toy")]) == 2
    errors = capfd.readouterr().err
    assert errors.endswith("; the policy comes before --darts\n")
    assert errors.startswith("error: 3: neither a run nor a checkpoint")


def test_another_action_or_observation_than_the_policys_is_refused(
    evaluate: Callable[..., Any], registries: Registries, monkeypatch: pytest.MonkeyPatch
) -> None:
    darts = registries.environments.get("darts").cls
    for method, changed, told in (
        ("actions", Box(-2.0, 2.0, (2,), np.float32), "actions: Box(-2.0, 2.0"),
        ("spaces", {"goal": Box(-9.0, 9.0, (2,), np.float32)}, "observation 'goal': Box(-9.0"),
    ):
        with monkeypatch.context() as patch:
            code, _, results = evaluate("darts")
            assert code == 0
            patch.setattr(darts, method, lambda self, changed=changed: changed)
            with pytest.raises(UserError, match=re.escape(told) + ".*was trained on Box"):
                evaluation.evaluate("toy", results_dir=results)


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        (EnvironmentFailure("a worker died"), "error: a worker died\n"),
        (NonFiniteError("step 4: the reward is nan"), "error: step 4: the reward is nan\n"),
    ],
)
def test_a_breakdown_is_told_without_a_traceback(
    evaluate: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
    failure: Exception,
    told: str,
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise failure

    monkeypatch.setattr(evaluation, "evaluate_policy", broken)
    assert evaluate("target")[:2] == (1, told)


def test_a_policy_that_is_not_there_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nowhere", "--throw"]) == 2
    assert "nowhere: neither a run nor a checkpoint" in capsys.readouterr().err


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


class TestEvaluationFolder:
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
