"""A request to stop, and the calls that are given up for it if they don't return."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE_S = 2.0
"""From a signal that asks to stop: calls that still run then are given up."""

_giving_up_allowed = False  # of the process, as signals are


class StopRequested(BaseException):
    """The user asked the run to stop. No `except Exception` of foreign code holds it up."""


@contextmanager
def may_be_given_up() -> Iterator[None]:
    """Marks a call of foreign code, which may not return, and of which nothing is needed then.

    Raises:
        StopRequested: `give_up` was called meanwhile.
    """
    global _giving_up_allowed  # noqa: PLW0603
    _giving_up_allowed = True
    try:
        yield
    finally:
        _giving_up_allowed = False


def give_up(*_signal: Any) -> None:
    """Ends a call that is marked so; handles SIGALRM.

    Raises:
        StopRequested: there is one.
    """
    if _giving_up_allowed:
        raise StopRequested
