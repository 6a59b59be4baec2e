"""Tables in pages."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.tables import write_between
from trainers.common.errors import UserError
from trainers.comparison.tables import markdown


def test_a_table_by_hand() -> None:
    assert markdown(["a", "b"], [["1", "2"]]) == ["| a | b |", "| --- | --- |", "| 1 | 2 |"]


def test_a_page_without_a_place_is_left_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- table -->\nno end\n")
    with pytest.raises(UserError, match=r"page\.md: there is no place"):
        write_between(page, "table", ["new"])
    assert page.read_text() == "before\n<!-- table -->\nno end\n"


def test_a_page_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere\.md: there is no place"):
        write_between(tmp_path / "nowhere.md", "table", ["new"])
