"""The page on policies in Python does what it says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trainers.inference.policy import Policy

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs/python.md").read_text()
SHAPE = Policy.load(REPOSITORY / "policies" / "grasp").observation_space["depth"].shape
FIRST, LOOP, SURE = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_three_lines_answer_with_an_action(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    known: dict[str, Any] = {"image": np.full(SHAPE, 1000, np.uint16)}
    exec(FIRST, known)
    assert known["action"].shape == (4,)


def test_the_loop_forgets_where_an_episode_ends() -> None:
    class Counting:
        def predict(self, observations: Any, state: Any) -> Any:
            return None, np.zeros((2, 1)) if state is None else state + 1.0

    class Twice:
        def step(self, actions: Any) -> Any:
            known["running"] = iterations.pop() > 0
            return None, None, np.array([True, False]), np.array([False, False]), {}

    iterations = [0, 1, 2]
    known: dict[str, Any] = {
        "policy": Counting(),
        "env": Twice(),
        "running": True,
        "observations": None,
    }
    exec(LOOP, known)
    assert known["state"].ravel().tolist() == [0.0, 2.0]


def test_the_robot_moves_where_the_answer_is_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    moves: list[Any] = []

    class Robot:
        move_to = staticmethod(moves.append)

    known: dict[str, Any] = {"image": np.zeros(SHAPE, np.uint16), "robot": Robot()}
    exec(FIRST, known)
    exec(SURE, known)
    assert not known["answer"].sure  # of a black image
    assert moves == []
