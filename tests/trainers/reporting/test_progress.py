"""What the terminal shows of a physical check."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from trainers.reporting import progress
from trainers.reporting.progress import CheckProgress, check_progress


def drawn(check: Any) -> str:
    console = Console(file=io.StringIO(), force_terminal=True, width=60)
    shown = CheckProgress(check, "drop_test", 40, console)
    console.print(shown.get_renderable())
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def test_it_shows_how_many_actions_were_tried_out_at_that_time() -> None:
    check = SimpleNamespace(tried_out=0)
    assert "drop test" in drawn(check)
    assert " 0/40" in drawn(check)
    check.tried_out = 37
    assert "37/40" in drawn(check)


@pytest.mark.parametrize("check", [None, SimpleNamespace(), SimpleNamespace(tried_out=3)])
def test_nothing_is_shown_of_no_check_or_to_nobody(
    check: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with check_progress(check, "throw", 40):
        pass
    assert capsys.readouterr() == ("", "")
    assert not isinstance(SimpleNamespace(), progress.Counting)
