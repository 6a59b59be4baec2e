"""Loops compiled at their first call, and kept on the disk where there is a place for them."""

from __future__ import annotations

import functools
import logging
import multiprocessing
from collections.abc import Callable
from typing import Any

import numba
from numba.core.caching import FunctionCache

_logger = logging.getLogger("ventosa")


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator that compiles a function at its first call.

    numba's own `cache=True` raises an error where no folder can be written, as in a read-only
    installation without a home, where the disk is full, and where what was kept is damaged. Here
    the function is compiled anew: nothing but time depends on what is kept.

    What is kept of a function is renewed when its own file changes, but not when a file it imports
    from does.

    Args:
        options: of `numba.njit`, but for `cache`.
    """

    def decorator(function: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher: Callable[..., Any] = numba.njit(**options)(function)
        try:
            dispatcher._cache = _Cache(function)  # type: ignore[attr-defined] # as cache=True does
        except RuntimeError:  # it has looked everywhere
            _tell_of_no_cache("neither the installation nor the user's cache can be written")
        return dispatcher

    return decorator


class _Cache(FunctionCache):
    """numba's cache on the disk, which may fail in any way."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What was kept for a signature; None where there is nothing, or nothing of use."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # anything can come out of a damaged file
            _logger.warning(
                "%s: what numba kept of it is damaged, and is renewed: %s: %s",
                self._name,
                type(error).__name__,
                error,
            )
            self._attempt(self.flush)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keeps what was compiled, if it can."""
        self._attempt(super().save_overload, sig, data)

    def _attempt(self, write: Callable[..., None], *arguments: Any) -> None:
        try:
            write(*arguments)
        except OSError as error:
            _tell_of_no_cache(f"numba's cache can't be written: {error.strerror or error}")


@functools.cache
def _tell_of_no_cache(reason: str) -> None:
    """Says it once, and in one of all the processes that simulate."""
    if multiprocessing.parent_process() is None:
        _logger.warning(
            "compiled loops can't be kept: %s; each start compiles them anew, for half a minute or "
            "more: NUMBA_CACHE_DIR may name a folder for them",
            reason,
        )
