"""The terminal's line while a physical check tries out one action after the other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from envs.evaluation import PhysicalCheck


@runtime_checkable
class Counting(Protocol):
    """A physical check that counts the actions that it is through with."""

    tried_out: int


class CheckProgress(Progress):
    """How many actions a check is through with, and the time left; asked for at each drawing.

    Args:
        check: counts them in `tried_out`.
        name: what reports call it.
        total: of all.
        console: where it is drawn.
    """

    def __init__(self, check: Counting, name: str, total: int, console: Console):
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        super().__init__(*columns, TimeRemainingColumn(), console=console, transient=True)
        self._check = check
        self.add_task(name.replace("_", " "), total=total)

    def get_renderable(self) -> RenderableType:
        """See `rich.progress.Progress`."""
        for task in self.task_ids:  # none yet while it is made
            self.update(task, completed=self._check.tried_out)
        return super().get_renderable()


@contextmanager
def check_progress(check: PhysicalCheck | None, name: str, total: int) -> Iterator[None]:
    """Shows how far a check is, where it tells that and somebody looks."""
    console = Console(stderr=True)
    if isinstance(check, Counting) and console.is_terminal:
        with CheckProgress(check, name, total, console):
            yield
    else:
        yield
