"""What all commands have in common."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from envs.environment import EnvironmentFailure
from trainers import calibrate, compare, evaluate, export, learn, plugins, predict, run
from trainers.common.errors import NonFiniteError, UserError
from trainers.common.options import version
from trainers.deployment import calibration, exporting, prediction
from trainers.runfile import registry
from trainers.sweep import __main__ as sweep

WORK: dict[ModuleType, tuple[ModuleType, str, list[str]]] = {
    calibrate: (calibration, "calibrate", ["run"]),
    compare: (registry, "load_registries", ["run.yaml"]),
    evaluate: (evaluate, "parse", ["run"]),
    export: (exporting, "export", ["run", "folder"]),
    learn: (run, "run_file", ["run.yaml"]),
    plugins: (registry, "load_registries", []),
    predict: (prediction, "predict", ["run", "image.png"]),
}
"""By command: where its work is done, by what function, and arguments."""


def test_all_commands_are_here() -> None:
    spine = Path(learn.__file__).parent
    commands = {path.stem for path in spine.glob("*.py") if "__main__" in path.read_text()}
    assert commands == {command.__name__.split(".")[-1] for command in WORK}


@pytest.mark.parametrize("command", WORK, ids=lambda command: command.__name__)
@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UserError("the way out"), 2),
        (EnvironmentFailure("a cable came loose"), 1),
        (NonFiniteError("the reward is nan"), 1),
        (KeyboardInterrupt(), 130),
    ],
    ids=repr,
)
def test_what_goes_wrong_is_a_line_and_an_exit_code(
    command: Any,
    error: BaseException,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    module, function, arguments = WORK[command]

    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(module, function, fail)
    if isinstance(error, KeyboardInterrupt) and command is learn:
        return  # it has signal handlers of its own: see tests/runs/test_ways_out.py
    assert command.main(arguments) == code
    assert capsys.readouterr().err == (f"error: {error}\n" if str(error) else "")


HELP = """
import sys
from importlib import import_module

for name in sys.argv[1:]:
    for option in ("--help", "--version"):
        try:
            import_module(name).main([option])
        except SystemExit as left:
            assert left.code == 0, name
    late = {"torch", "numpy", "gymnasium", "rich", "cv2", "numba", "pybullet", "optuna"}
    assert not late & sys.modules.keys(), f"{name}: {late & sys.modules.keys()}"
"""


def test_help_and_version_are_told_before_anything_large_is_imported() -> None:
    names = [command.__name__ for command in (*WORK, sweep)]
    done = subprocess.run(
        [sys.executable, "-c", HELP, *names], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("--version") == 2 * len(names)  # usage, and the option itself
    assert done.stdout.count(f"{version()}\n") == len(names)


def test_help_tells_defaults_that_say_something(capsys: pytest.CaptureFixture[str]) -> None:
    for main in (calibrate.main, learn.main):
        with pytest.raises(SystemExit):
            main(["--help"])
    told = " ".join(capsys.readouterr().out.split())
    for text in ("of the episodes (default: 0)", "where runs are kept (default: results)"):
        assert text in told
    for text in ("(default: None)", "(default: False)", "(default: [])"):
        assert text not in told
