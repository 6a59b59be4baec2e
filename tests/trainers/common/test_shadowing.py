"""Folders and distributions that have a package of ours: every command says so, in a line."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from trainers.common.shadowing import HOME

SPINE = sorted(
    path.relative_to(HOME).with_suffix("").as_posix().replace("/", ".")
    for folder in ("trainers", "benchmarks")
    for path in (*(HOME / folder).glob("*.py"), *(HOME / folder).glob("*/__main__.py"))
    if 'if __name__ == "__main__":' in path.read_text()
)
"""All modules that are commands."""
Python = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def python(tmp_path: Path) -> Python:
    """Runs Python in a folder whose modules come before ours."""

    def run(*arguments: str, path: str = str(HOME)) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    return run


@pytest.mark.parametrize("command", SPINE)
def test_a_folder_of_ones_own_is_told_from_ours(
    command: str, python: Python, tmp_path: Path
) -> None:
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs/__init__.py").touch()
    done = python("-m", command, "--help")
    assert done.returncode == 2
    assert done.stderr == (
        f"error: {tmp_path}/envs would be imported in the place of {HOME}/envs: the current folder "
        "is searched first; say `ventosa COMMAND` instead of `python -m trainers.COMMAND`, go to "
        "another folder, or rename it\n"
    )


def test_so_is_a_module(python: Python, tmp_path: Path) -> None:
    (tmp_path / "rewards.py").touch()
    done = python("-m", "trainers.learn", "--help")
    assert done.stderr.startswith(f"error: {tmp_path}/rewards.py would be imported in the place")


def test_whoever_imports_ventosa_is_told_by_an_error(python: Python, tmp_path: Path) -> None:
    (tmp_path / "envs.py").touch()
    done = python("-c", "from trainers.inference.policy import Policy")
    assert done.stderr.splitlines()[-1].startswith(f"ImportError: {tmp_path}/envs.py would be imp")


def test_another_distribution_is_named(python: Python, tmp_path: Path) -> None:
    site = tmp_path / "site"
    (site / "encoders").mkdir(parents=True)
    (site / "encoders/__init__.py").touch()
    (site / "audio-2.0.dist-info").mkdir()
    (site / "audio-2.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: audio\n")
    (site / "audio-2.0.dist-info/RECORD").write_text("encoders/__init__.py,,\n")
    done = python("-m", "trainers.learn", "--help", path=f"{site}{os.pathsep}{HOME}")
    assert done.returncode == 2
    assert "audio has a package of that name; use a virtual environment without" in done.stderr


def test_a_folder_without_python_hides_nothing(python: Python, tmp_path: Path) -> None:
    (tmp_path / "rewards").mkdir()
    done = python("-m", "trainers.learn", "--help")
    assert done.returncode == 0
