"""Experiments side by side, from the command line."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from trainers.common.command import DONE, FAILED, MISTAKE
from trainers.compare import main, parse_options
from trainers.comparison.planning import PlannedRun, plan
from trainers.runfile.registry import load_registries
from trainers.saving.run_folder import CONFIGURATION

RUN_FILE = """
environment: {type: gymnasium, id: CartPole-v1, num_envs: 2}
trainer:
  trainer_type: ppo
  max_steps: 128
  summary_freq: 64
  hyperparameters: {buffer_size: 64, batch_size: 32, num_epoch: 1}
  network_settings: {hidden_units: 8, num_layers: 1}
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "files" / "pole.yaml"
    path.parent.mkdir()
    path.write_text(RUN_FILE)
    return path


def planned(config: Path, results: Path, **options: Any) -> list[PlannedRun]:
    words = [str(config), "--results-dir", str(results)]
    for name, value in options.items():
        words += [f"--{name.replace('_', '-')}", str(value)]
    parsed = parse_options(words)
    return list(plan(parsed, parsed.paths))


def test_where_a_run_was_computed_makes_it_no_other(
    config: Path, tmp_path: Path, learn: Callable[..., Any]
) -> None:
    (run,) = planned(config, tmp_path, seeds=1, device="cuda")
    assert list(run.overrides) == ["device=cuda", "seed=0"]
    learn(config, "seed=0", "--run-id", run.folder.name, results_dir=tmp_path)
    assert not run.job(load_registries()).missing


def test_runs_what_is_missing_and_reports_on_all(
    config: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    results, folder = tmp_path / "runs", tmp_path / "report"
    words = [str(config.parent), "--seeds", "2", "--results-dir", str(results)]
    assert main([*words, "--report", str(folder)]) == DONE
    assert re.search(r"pole-0 begins\n", capfd.readouterr().out)
    page = (folder / "report.md").read_text()
    assert "| pole | 2 | 128 |" in page
    assert page.count("finished") == 1
    before = {path: path.stat().st_mtime_ns for path in results.rglob("*")}
    # Runs made elsewhere join those that they differ from in the seed alone.
    shutil.copytree(results / "pole-1", tmp_path / "theirs")
    configuration = tmp_path / "theirs" / CONFIGURATION
    configuration.write_text(configuration.read_text().replace("seed: 1", "seed: 5"))
    assert main([*words, str(tmp_path / "theirs"), "--report", str(folder)]) == DONE
    assert "begins" not in capfd.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in results.rglob("*")} == before
    assert "| pole | 3 | 128 |" in (folder / "report.md").read_text()


def test_what_is_damaged_or_missing_is_told_of_beside_the_others(
    config: Path, tmp_path: Path, learn: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "runs"
    for seed in (0, 1):
        learn(config, f"seed={seed}", "--run-id", f"pole-{seed}", results_dir=results)
    status = results / "pole-1" / "status.json"
    status.write_text(status.read_text()[:40])
    damaged = status.read_bytes()
    shutil.copytree(results / "pole-0", tmp_path / "theirs")
    (tmp_path / "theirs" / CONFIGURATION).write_text("{")
    words = [str(config), "--seeds", "2", "--results-dir", str(results), str(tmp_path / "theirs")]
    assert main(words) == FAILED
    assert f"{status}: can't be read" in capfd.readouterr().err
    page = (results / "report.md").read_text()
    assert f"finished, unreadable: {status}: can't be read" in page
    assert f"| theirs | 1 | 0 |  |  |  |  | 0.00 | unreadable: {tmp_path / 'theirs'}" in page
    assert status.read_bytes() == damaged


def test_a_folder_of_runs_stands_for_its_runs(
    config: Path, tmp_path: Path, learn: Callable[..., Any]
) -> None:
    for seed in (0, 1):
        learn(config, f"seed={seed}", "--run-id", f"pole-{seed}", results_dir=tmp_path / "runs")
    assert main([str(tmp_path / "runs"), "--report", str(tmp_path)]) == DONE
    assert "| pole | 2 | 128 |" in (tmp_path / "report.md").read_text()


def test_runs_of_one_seed_are_not_one_experiment(
    config: Path, tmp_path: Path, learn: Callable[..., Any]
) -> None:
    """Nor is a run file that is named twice two."""
    learn(config, "--run-id", "one", results_dir=tmp_path)
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    assert main([str(tmp_path / "one"), str(tmp_path / "two"), "--report", str(tmp_path)]) == DONE
    page = (tmp_path / "report.md").read_text()
    assert "| one | 1 |" in page
    assert "| two | 1 |" in page
    twice = parse_options([str(config), str(config.parent), "--seeds", "1"])
    assert len(list(plan(twice, twice.paths))) == 1


def test_each_seed_and_number_of_steps_has_a_run_of_its_own(config: Path, tmp_path: Path) -> None:
    runs = planned(config, tmp_path, seeds=2, max_steps=64)
    assert [run.folder.name for run in runs] == ["pole-64-0", "pole-64-1"]
    assert [list(run.overrides) for run in runs] == [
        ["trainer.max_steps=64", "seed=0"],
        ["trainer.max_steps=64", "seed=1"],
    ]
    assert [run.folder.name for run in planned(config, tmp_path, seeds=1)] == ["pole-0"]


def test_what_was_interrupted_goes_on_and_what_has_no_checkpoint_begins_anew(
    config: Path, tmp_path: Path, learn: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    registries = load_registries()
    monkeypatch.setattr("trainers.run.load_registries", lambda: registries)
    (run,) = planned(config, tmp_path, seeds=1)
    job = run.job(registries)
    assert job.missing
    assert not {"--resume", "--force"} & set(job.commands[0])
    learned = learn(config, "seed=0", "--run-id", "pole-0", results_dir=tmp_path)
    assert learned.code == DONE, learned.errors
    assert not run.job(registries).missing
    status = run.folder / "status.json"
    status.write_text(status.read_text().replace('"finished"', '"interrupted"'))
    assert run.job(registries).missing
    assert "--resume" in run.job(registries).commands[0]
    shutil.rmtree(run.folder / "checkpoints")
    assert "--force" in run.job(registries).commands[0]


def test_what_another_run_file_made_is_left_alone(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run,) = planned(config, tmp_path / "runs", seeds=1)
    run.folder.mkdir(parents=True)
    other = yaml.safe_load(RUN_FILE)
    other["trainer"]["hyperparameters"]["batch_size"] = 16
    (run.folder / CONFIGURATION).write_text(yaml.safe_dump(other))
    assert main([str(config), "--seeds", "1", "--results-dir", str(tmp_path / "runs")]) == MISTAKE
    errors = capsys.readouterr().err
    assert f"{run.folder}: what is there was made by another run file than {config}: " in errors
    assert list(run.folder.iterdir()) == [run.folder / CONFIGURATION]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["missing.yaml"], "missing.yaml: there is no such file"),
        (["empty"], "empty: neither a run (no configuration.yaml) nor a folder of run files"),
        (["a/same.yaml", "b/same.yaml"], "a/same.yaml and b/same.yaml have the same name"),
        (["wrong.yaml"], "wrong.yaml:1: no_such_key: "),
    ],
)
def test_mistakes_are_told_before_any_run_begins(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b", "empty"):
        Path(name).mkdir()
        if name != "empty":
            Path(name, "same.yaml").write_text(RUN_FILE)
    Path("wrong.yaml").write_text("no_such_key: 1\n" + RUN_FILE)
    assert main([*words, "--seeds", "1"]) == MISTAKE
    assert message in capsys.readouterr().err
    assert not Path("results").exists()


@pytest.mark.parametrize("option", ["--seeds", "--jobs", "--max-steps"])
def test_counts_are_whole_numbers_from_1(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["x.yaml", option, "0"])
    assert "should be a whole number from 1 to 2147483647, not '0'" in capsys.readouterr().err
