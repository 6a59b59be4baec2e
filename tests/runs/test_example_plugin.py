"""The example plugin, installed as a user would and used in a run."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

REPOSITORY = Path(__file__).parents[2]
EXAMPLE = REPOSITORY / "examples/ventosa-example-plugin"
ORIGIN = "ventosa-example-plugin 0.1.0"


def run(python: Path, *arguments: str) -> str:
    """Run Python in the repository's root and return what it printed."""
    done = subprocess.run(
        [str(python), *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def python(
    tmp_path_factory: pytest.TempPathFactory, borrowing_venv: Callable[[Path], Path]
) -> Path:
    """Make a virtual environment with the example, which borrows all else from this one."""
    folder = tmp_path_factory.mktemp("plugin")
    interpreter = borrowing_venv(folder / "venv") / Path(sys.executable).name
    # A copy: building leaves files beside the sources.
    source = shutil.copytree(EXAMPLE, folder / "source")
    options = ("--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    run(interpreter, "-m", "pip", "install", "--quiet", *options, str(source))
    return interpreter


def test_its_components_are_listed_with_where_they_came_from(python: Path) -> None:
    listed = json.loads(run(python, "-m", "trainers.plugins", "--json"))
    theirs = [row for row in listed if row["origin"] == ORIGIN]
    names = {(row["kind"], row["name"], row["settings"][0]["name"]) for row in theirs}
    assert names == {("encoder", "mean_pool", "grid"), ("reward", "near", "scale_m")}
    assert {row["plugin"] for row in theirs} == {"example"}
    assert ("reward", "touch") in {(row["kind"], row["name"]) for row in listed}


def test_a_run_learns_with_it(python: Path, tmp_path: Path) -> None:
    run(
        python,
        "-m",
        "trainers.learn",
        "config/quick.yaml",
        "environment.num_envs=2",
        "trainer.max_steps=128",
        "trainer.hyperparameters.buffer_size=64",
        "trainer.hyperparameters.batch_size=32",
        "encoders.depth={type: mean_pool, grid: 8}",
        "rewards=[{type: touch},{type: near, scale_m: 0.1}]",
        "--results-dir",
        str(tmp_path),
        "--run-id",
        "plugin",
    )
    written = (tmp_path / "plugin/configuration.yaml").read_text()
    assert "mean_pool" in written
    assert "near" in written


def test_near_falls_by_e_over_each_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    from ventosa_example.near import Near

    transition = SimpleNamespace(
        tooltip_m=np.array([[1.0, 0.0, 0.5], [1.0, 0.0, 0.5]]),
        target_point_m=np.array([[1.0, 0.0, 0.5], [1.3, 0.4, 0.5]]),
    )
    rewards = Near(Near.Settings(scale_m=0.5))(transition)
    np.testing.assert_allclose(rewards, [1.0, 0.36787944117144233])


def test_mean_pool_averages_the_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    from ventosa_example.mean_pool import MeanPool

    space = Box(-np.inf, np.inf, (4, 2, 1), np.float32)
    encoder = MeanPool(space, MeanPool.Settings(grid=2))
    image = torch.tensor([[1.0, 5.0], [3.0, 7.0], [0.0, 4.0], [2.0, 4.0]]).reshape(1, 4, 2, 1)
    assert encoder.features_dim == 4
    assert encoder(image).tolist() == [[2.0, 6.0, 1.0, 4.0]]
