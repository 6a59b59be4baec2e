"""Missing extras are told without tracebacks."""

from __future__ import annotations

import sys

import pytest

from benchmarks.command import missing, require
from trainers.common.errors import UserError

INSTALL = "pip install -c constraints.txt -e '.[bench]'"


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert missing("json", "scipy") == ["scipy"]
    with pytest.raises(UserError, match="not installed: scipy, of the extra `bench`") as caught:
        require("json", "scipy")
    assert INSTALL in str(caught.value)
    require("json")


@pytest.mark.parametrize(
    ("module", "arguments"),
    [("learning", []), ("speed", ["--track", "nowhere/history.jsonl"])],
)
def test_commands_name_the_extra_at_once(
    module: str,
    arguments: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    main = __import__(f"benchmarks.{module}.__main__", fromlist=["main"]).main
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert main(arguments) == 2
    assert INSTALL in capsys.readouterr().err
