"""`ventosa COMMAND`: one word chooses the command, the rest is its own."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from trainers.common.command import MISTAKE
from trainers.common.options import program
from trainers.common.shadowing import HOME
from trainers.console.__main__ import COMMANDS, look_here_last, main


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, which is not on Python's path; what is changed is put back."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    return tmp_path


def test_every_command_has_a_name() -> None:
    spine = [
        path.relative_to(HOME).with_suffix("")
        for path in (HOME / "trainers").rglob("*.py")
        if 'if __name__ == "__main__":' in path.read_text()
    ]
    modules = {".".join(path.parts) for path in spine} - {"trainers.console.__main__"}
    assert {module for module, _ in COMMANDS.values()} == modules | {"trainers.console.init"}
    for name, (module, _) in COMMANDS.items():
        assert name in module.split(".")


def test_a_command_is_given_the_rest(elsewhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learn = importlib.import_module("trainers.learn")
    monkeypatch.setattr(learn, "main", lambda words: len(words) if "--help" in words else -1)
    assert main(["learn", "--version", "--help", "init"]) == 3


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ([], 0, "copy a run file"),
        (["--help"], 0, "copy a run file"),
        (["--version"], 0, "ventosa "),
        (["lern"], MISTAKE, "invalid choice: 'lern'"),
    ],
)
def test_without_a_command_there_is_help(
    words: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == code
    assert said in "".join(capsys.readouterr())


def test_modules_here_are_found_after_ours(elsewhere: Path) -> None:
    for name in ("envs", "my_env"):
        (elsewhere / f"{name}.py").touch()
    look_here_last()
    assert sys.path[-2:] == [str(HOME), str(elsewhere)]
    command = "import envs, my_env; print(envs.__file__, my_env.__file__)"
    code = f"import sys; sys.path[:] = {sys.path!r}; {command}"
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert printed.split() == [f"{HOME}/envs/__init__.py", f"{elsewhere}/my_env.py"]
    assert os.environ["PYTHONSAFEPATH"] == "1"


def test_under_python_m_nothing_is_changed(elsewhere: Path) -> None:
    sys.path.insert(0, str(elsewhere))
    before = list(sys.path)
    look_here_last()
    assert sys.path == before
    assert not os.environ["PYTHONSAFEPATH"]


def test_help_says_how_a_command_was_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/venv/bin/ventosa", "learn"])
    assert program("learn") == "ventosa learn"
    monkeypatch.setattr(sys, "argv", ["/clone/trainers/learn.py"])
    assert program("learn") == "python -m trainers.learn"


def test_help_takes_nothing_that_is_slow() -> None:
    code = (
        "import sys; from trainers.console.__main__ import parse; parse(['learn']); "
        "print({'numpy', 'torch', 'gymnasium', 'pydantic', 'yaml'} & sys.modules.keys())"
    )
    assert subprocess.check_output([sys.executable, "-c", code], cwd=HOME, text=True) == "set()\n"
