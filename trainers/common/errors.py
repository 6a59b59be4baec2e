"""Mistakes of the user's, as opposed to failures of the program, and the way out of them."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from pydantic import ValidationError


class UserError(Exception):
    """The user's mistake: the message names it and the way out, and no traceback is shown."""


class Failure(Exception):  # noqa: N818 - Error would say that something is wrong with ventosa
    """Why a command can't go on, through no mistake of the user's and none of ventosa's.

    The message says it all, and no traceback is shown.
    """


class UnwritableError(Failure, OSError):
    """A file can't be written, on a full or a read-only disk for instance: `filename` is which."""

    def __str__(self) -> str:
        """Which and why."""
        return f"{self.filename}: {self.strerror}"


class NonFiniteError(Failure):
    """NaN or infinity where learning can't go on; the message names what, where and when."""


def suggestion(name: str, known: Iterable[str]) -> str:
    """Say which known name is meant, or which ones there are."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=2)
    if close:
        return "did you mean " + " or ".join(f"'{match}'" for match in close) + "?"
    return f"known: {', '.join(names)}" if names else "none is known"


def first_lines(error: Exception, count: int) -> str:
    """The first so many lines of a message that goes on for many, such as torch's, in one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:count]).rstrip(".")


def reason(error: Exception) -> str:
    """Why a file's content is refused, in a line: of several things that don't fit, the first."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))
    said = str(error).splitlines()
    return said[0] if said else type(error).__name__
