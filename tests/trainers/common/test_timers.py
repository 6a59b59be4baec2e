"""The tree of timers."""

from __future__ import annotations

import time
from typing import Any

import pytest

from trainers.common.timers import Timer, add_timed, recording, timed


def find(tree: dict[str, Any], *path: str) -> dict[str, Any]:
    for name in path:
        (tree,) = (child for child in tree["children"] if child["name"] == name)
    return tree


def test_parts_are_counted_where_they_are_entered() -> None:
    root = Timer()
    with recording(root):
        for _ in range(3):
            with timed("collect"), timed("step"):
                pass
        with timed("update"), timed("step"):
            pass
    tree = root.tree()
    assert find(tree, "collect")["count"] == 3
    assert find(tree, "collect", "step")["count"] == 3
    assert find(tree, "update", "step")["count"] == 1
    assert tree["name"] == "root"
    assert tree["count"] == 1


def test_a_part_holds_its_children_and_the_rest_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    root = Timer()
    clock = iter([0.0, 1.0, 2.0, 5.0, 9.0, 10.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    with recording(root), timed("outer"), timed("inner"):
        pass
    tree = root.tree()
    assert find(tree, "outer", "inner")["total"] == 3.0  # from 2 to 5
    assert find(tree, "outer")["total"] == 8.0  # from 1 to 9
    assert find(tree, "outer")["self"] == 5.0
    assert tree["total"] == 10.0


def test_what_was_timed_elsewhere_is_a_part() -> None:
    root = Timer()
    add_timed("lost", 1.0)  # nothing records
    with recording(root), timed("outer"):
        add_timed("part", 0.25)
        add_timed("part", 0.5)
    assert find(root.tree(), "outer", "part")["total"] == 0.75
    assert find(root.tree(), "outer", "part")["count"] == 2
    assert len(root.children) == 1


def test_an_error_ends_its_parts() -> None:
    root = Timer()
    with recording(root):
        with pytest.raises(ValueError, match="stop"), timed("outer"), timed("inner"):
            raise ValueError("stop")
        with timed("next"):
            pass
    assert [child["name"] for child in root.tree()["children"]] == ["outer", "next"]


def test_nothing_is_kept_outside_a_recording() -> None:
    with timed("lost"):
        pass
    root = Timer()
    with recording(root):
        pass
    assert root.tree()["children"] == []
