"""The wheel, installed as a user would, in a folder that has nothing but a package of their own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from zipfile import ZipFile

import pytest

REPOSITORY = Path(__file__).parents[2]
SOURCES = ("trainers", "envs", "encoders", "rewards", "curricula", "config", "policies")
ENVIRONMENT = """
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv
gymnasium.register("Mine-v0", entry_point=CartPoleEnv, max_episode_steps=20)
"""


def run(command: list[str | Path], folder: Path) -> str:
    """Runs a command that knows nothing of this clone, and returns what it printed."""
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=folder, env=clean, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in SOURCES:
        shutil.copytree(
            REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source)
    options = ("--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--quiet")
    run([sys.executable, "-m", "pip", "wheel", *options, "-w", folder, "./source"], folder)
    [built] = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def ventosa(
    wheel: Path,
    tmp_path_factory: pytest.TempPathFactory,
    borrowing_venv: Callable[[Path], Path],
) -> Callable[..., str]:
    """Runs `ventosa` in an empty folder but for `envs/`, which is the user's, and a module."""
    home, here = tmp_path_factory.mktemp("venv"), tmp_path_factory.mktemp("here")
    scripts = borrowing_venv(home)
    options = ("--no-deps", "--no-index", "--disable-pip-version-check", "--quiet")
    run([scripts / "python", "-m", "pip", "install", *options, wheel], home)
    (here / "envs").mkdir()
    (here / "envs/__init__.py").write_text("raise ImportError('not what was meant')")
    (here / "mine.py").write_text(ENVIRONMENT)
    return lambda *words: run([scripts / "ventosa", *words], here)


def test_it_has_the_run_files_and_the_policies(wheel: Path) -> None:
    here = {path for path in (REPOSITORY / "config").rglob("*") if path.is_file()}
    here |= {path for path in (REPOSITORY / "policies").glob("*/*") if path.is_file()}
    expected = {path.relative_to(REPOSITORY).as_posix() for path in here}
    names = ZipFile(wheel).namelist()
    split = (name.partition(".data/data/share/ventosa/") for name in names)
    assert {shared for _, _, shared in split if shared} == expected
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "config/"))]


def test_init_finds_them_there(ventosa: Callable[..., str]) -> None:
    assert ventosa("--version") == f"ventosa {version('ventosa')}\n"
    assert "policies/grasp_gaussian" in ventosa("init")
    copied = "paper/lstm.yaml\npaper/stream.yaml\nschema.json\n"
    assert ventosa("init", "paper/lstm") == copied


@pytest.mark.soak
def test_a_run_and_an_evaluation_need_no_clone(ventosa: Callable[..., str]) -> None:
    ventosa("init", "gymnasium/cartpole_ppo")
    run_file = "gymnasium/cartpole_ppo.yaml"
    ventosa("learn", run_file, "trainer.max_steps=2048", "environment.id=mine:Mine-v0")
    assert "return" in ventosa("evaluate", "results/cartpole_ppo", "--trust", "--episodes", "5")
    ventosa("init", "policies/grasp_gaussian")
    assert "position error" in ventosa("evaluate", "policies/grasp_gaussian", "--episodes", "8")
