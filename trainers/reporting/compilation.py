"""Kernels that numba compiles, which keeps the first start waiting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

COMPILE = "numba:compile"
"""numba's event: it does not happen where a cache has the kernel."""
NOTICE = "compiling kernels with numba: the first start takes a minute or two longer"


class Compilation(event.Listener):
    """Hears of kernels that are compiled.

    Args:
        tell: is told so, once.

    Attributes:
        happened: whether there were any.
    """

    def __init__(self, tell: Callable[[str], None]):
        self.happened, self._tell = False, tell

    def on_start(self, _event: Any) -> None:
        """Called before a kernel is compiled."""
        if not self.happened:
            self.happened = True
            self._tell(NOTICE)

    def on_end(self, _event: Any) -> None:
        """Called afterwards."""


@contextmanager
def telling_of_compilation(tell: Callable[[str], None]) -> Iterator[Compilation]:
    """Tells once that kernels are compiled, if any is."""
    compilation = Compilation(tell)
    with event.install_listener(COMPILE, compilation):
        yield compilation
