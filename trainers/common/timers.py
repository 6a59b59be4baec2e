"""Times of a run's parts: a tree of named timers, as ML-Agents writes it to timers.json."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

ROOT = "root"


@dataclass
class Timer:
    """A part of the run: how often it was entered, how long it took, and its own parts."""

    count: int = 0
    total_s: float = 0.0
    children: dict[str, Timer] = field(default_factory=dict)

    def tree(self, name: str = ROOT) -> dict[str, Any]:
        """Plain data: seconds in all (`total`) and outside the parts (`self`), calls and parts."""
        inside_s = sum(child.total_s for child in self.children.values())
        return {
            "name": name,
            "total": self.total_s,
            "count": self.count,
            "self": max(self.total_s - inside_s, 0.0),
            "children": [child.tree(part) for part, child in self.children.items()],
        }


_current: ContextVar[Timer | None] = ContextVar("current_timer", default=None)


@contextmanager
def recording(root: Timer) -> Iterator[None]:
    """Records what is timed inside, as parts of `root`."""
    with _entered(root):
        yield


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Times a part, below the part it is called in; costs next to nothing outside a recording."""
    parent = _current.get()
    if parent is None:
        yield
        return
    with _entered(parent.children.setdefault(name, Timer())):
        yield


def add_timed(name: str, total_s: float) -> None:
    """Adds a part that was timed elsewhere, such as in another process."""
    parent = _current.get()
    if parent is not None:
        timer = parent.children.setdefault(name, Timer())
        timer.total_s, timer.count = timer.total_s + total_s, timer.count + 1


@contextmanager
def _entered(timer: Timer) -> Iterator[None]:
    token, start_s = _current.set(timer), time.perf_counter()
    try:
        yield
    finally:
        timer.total_s += time.perf_counter() - start_s
        timer.count += 1
        _current.reset(token)
