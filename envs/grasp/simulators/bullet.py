"""PyBullet, imported without the line that it prints: when it was built, which is of no use."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

STDERR = 2


@contextmanager
def _discarded_errors() -> Iterator[None]:
    """Discards what C code writes to standard error; exceptions are none of it."""
    if sys.__stderr__ is None:  # closed before Python began
        yield
        return
    kept, null = os.dup(STDERR), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, STDERR)
    try:
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
        os.close(null)


with _discarded_errors():
    import pybullet  # noqa: F401
