"""What all commands have in common."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from envs.environment import EnvironmentFailure
from trainers import calibrate, compare, evaluate, export, learn, plugins, predict, run
from trainers.common.errors import NonFiniteError, UserError

WORK: dict[ModuleType, tuple[ModuleType, str, list[str]]] = {
    calibrate: (calibrate, "calibrate", ["run"]),
    compare: (compare, "load_registries", ["run.yaml"]),
    evaluate: (evaluate, "parse", ["run"]),
    export: (export, "export", ["run", "folder"]),
    learn: (run, "run_file", ["run.yaml"]),
    plugins: (plugins, "load_registries", []),
    predict: (predict, "predict", ["run", "image.png"]),
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
