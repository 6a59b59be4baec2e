"""Missing extras are told without tracebacks."""

from __future__ import annotations

import sys
from importlib import import_module

import pytest

from benchmarks.command import missing


def test_missing_packages_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert missing("json", "scipy") == ["scipy"]


@pytest.mark.parametrize(
    ("module", "package", "extra", "arguments"),
    [
        ("learning.__main__", "scipy", "bench", []),
        ("learning.__main__", "stable_baselines3", "bench", []),
        ("speed.__main__", "stable_baselines3", "bench", ["--track", "nowhere/history.jsonl"]),
        ("robustness", "matplotlib", "render", ["nowhere", "--plot", "curves.png"]),
    ],
)
def test_commands_name_the_extra_at_once(
    module: str,
    package: str,
    extra: str,
    arguments: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    main = import_module(f"benchmarks.{module}").main
    monkeypatch.setitem(sys.modules, package, None)
    assert main(arguments) == 2
    told = f"error: {package} is not installed: pip install 'ventosa[{extra}]'\n"
    assert capsys.readouterr().err == told
