"""Standard streams that nobody may read any more."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO, cast


class _FallingSilent:
    """A stream that falls silent, for good, once it can't be written: behind `| head -1`, say."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError:
            self._fall_silent()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            self._fall_silent()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _fall_silent(self) -> None:
        # The descriptor itself: what the stream still holds would fail again when Python ends.
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)


@contextmanager
def falling_silent() -> Iterator[None]:
    """Lets both standard streams fall silent where they can't be written, instead of failing.

    A pipe may be closed, a terminal gone, the disk of a file full: no reason to lose a run.
    """
    if sys.stdout is None or sys.stderr is None:  # closed before Python began
        yield
        return
    out, err = _FallingSilent(sys.stdout), _FallingSilent(sys.stderr)
    with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)):
        try:
            yield
        finally:
            out.flush()
            err.flush()
