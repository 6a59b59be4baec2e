"""The recipe with one change at a time."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from benchmarks import ablation
from trainers.common.command import MISTAKE
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import load_run

RECIPES = ablation.load_recipes()
RUN = RECIPES["run"]
NONE = RUN.changes["none"]
CHANGES = [
    (recipe, change)
    for recipe in RECIPES.values()
    for change in recipe.changes.values()
    if change.slug != "none"
]
# The paper's encoder has a learning rate of its own, or it learns nothing at all; and an encoder
# may want other pixels.
SEVERAL = {"paper-encoder", "keypoints", "fewer-pixels"}


@pytest.mark.parametrize(
    ("recipe", "change"), CHANGES, ids=[f"{r.name}-{c.slug}" for r, c in CHANGES]
)
def test_every_change_changes_one_section(recipe: ablation.Recipe, change: ablation.Change) -> None:
    registries = load_registries()
    as_it_is = load_run(recipe.run_file, (), registries)
    changed = load_run(recipe.run_file, change.overrides, registries)
    sections = [
        field.name
        for field in fields(as_it_is)
        if getattr(as_it_is, field.name) != getattr(changed, field.name)
    ]
    assert sections
    assert len(sections) == 1 or change.slug in SEVERAL


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=lambda recipe: recipe.name)
def test_every_row_of_a_recipe_is_judged_alike(recipe: ablation.Recipe) -> None:
    registries = load_registries()
    judged = [
        load_run(recipe.run_file, [*change.overrides, *recipe.evaluated], registries)
        for change in recipe.changes.values()
    ]
    sensors = {
        str(run.environment.settings.cameras["depth"].sensor)  # type: ignore[attr-defined]
        for run in judged
    }
    assert len(sensors) == 1
    assert len({str(run.environment.settings.randomize) for run in judged}) == 1  # type: ignore[attr-defined]


def test_a_change_that_the_recipe_does_not_have_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert ablation.main(["structured_light", "--changes", "aside"]) == MISTAKE
    assert "--changes: no 'aside' in none, keypoints, " in capsys.readouterr().err


def report(success: float) -> dict[str, Any]:
    return {
        "first_action_success": success,
        "position_error_m": {"median": success / 100.0, "p95": 0.02, "x": 0.0},
        "yaw_error_deg": {"median": 0.5, "p95": 1.5},
    }


ROW = ["none: config/run.yaml", "60.0 % (50.0 to 70.0)", "6.0 / 20.0", "0.50 / 1.50"]


def test_a_row_by_hand() -> None:
    assert ablation.row(NONE, [report(0.5), report(0.7)]) == ROW


def test_the_page_gets_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed, success in ((4, 0.5), (5, 0.7)):
        (tmp_path / f"run-none-1000-{seed}.json").write_text(json.dumps(report(success)))
    page = tmp_path / "page.md"
    page.write_text("<!-- ablation run -->\n<!-- end of ablation run -->\n")
    chosen = ["--changes", "none", "--seeds", "4", "5", "--steps", "1000"]
    assert ablation.main([*chosen, "--results", str(tmp_path), "--page", str(page)]) == 0
    assert "| " + " | ".join(ROW) + " |" in page.read_text()
    assert "1,000 steps, 2 seeds" in capsys.readouterr().out


def test_a_run_is_trained_then_evaluated(tmp_path: Path) -> None:
    job = ablation.job_of(
        ablation.Recipe("run", ["c=2"], {}),
        ablation.Change("x", "y", ("a.b=1",)),
        7,
        1000,
        tmp_path,
    )
    learn, evaluate = job.commands
    assert learn[:2] == ["-m", "trainers.learn"]
    assert {"a.b=1", "trainer.max_steps=1000", "run-x-1000-7", "7"} <= set(learn)
    assert evaluate[-2:] == ["--json", str(tmp_path / "run-x-1000-7.json")]
    assert str(tmp_path / "runs" / "run-x-1000-7") in evaluate
    assert "c=2" in evaluate


@pytest.mark.soak
def test_told_to_stop_it_stops_its_runs(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "run-none-1000000-0"
    command = ["--changes", "none", "--seeds", "0", "--steps", "1000000", "--results", tmp_path]
    with subprocess.Popen([sys.executable, "-m", "benchmarks.ablation", *command]) as process:
        try:
            while not (run / "status.json").exists() and process.poll() is None:
                time.sleep(0.05)
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=120.0) == 128 + signal.SIGTERM
        finally:
            process.kill()
    assert json.loads((run / "status.json").read_text())["state"] == "interrupted"
    assert not (run / "run.lock").exists()
