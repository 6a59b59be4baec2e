"""Threads among which the rows of a compiled loop are divided."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numba

from trainers.common.cores import usable_cores

# A part costs the call of a compiled function, some 15 us.
PARTS_PER_THREAD = 2
MIN_ROWS_PER_PART = 8


class ThreadPool:
    """The calling thread and its helpers. Who is free takes the next part of the rows.

    So the caller never waits for a helper that has not got a processor, as it would with the
    barriers of OpenMP, on machines where others compute as well.

    Args:
        threads: how many, with the caller; None: one for each core that may be used, or fewer
            where numba's own variable `NUMBA_NUM_THREADS` says so.

    Raises:
        ValueError: `threads` is less than one.
    """

    def __init__(self, threads: int | None = None):
        if threads is not None and threads < 1:
            raise ValueError(f"{threads} threads: there must be at least 1")
        most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # set as it is read
        self._threads = threads = threads or min(usable_cores(), most)
        self._helpers = ThreadPoolExecutor(threads - 1) if threads > 1 else None

    def parallel_for(self, work: Callable[[int, int], None], rows: int) -> None:
        """Calls `work` with the first and the end of parts that make up all the rows.

        Args:
            work: must leave Python's lock alone for most of its time, or nothing is won.
            rows: how many.
        """
        size = max(MIN_ROWS_PER_PART, -(-rows // (self._threads * PARTS_PER_THREAD)))
        if self._helpers is None or rows <= size:
            work(0, rows)
            return
        parts = range(0, rows, size)
        begins = iter(parts)

        def take_parts() -> None:
            for begin in begins:
                work(begin, min(begin + size, rows))

        helping = [
            self._helpers.submit(take_parts) for _ in range(min(self._threads, len(parts)) - 1)
        ]
        take_parts()
        for helper in helping:
            if not helper.cancel():
                helper.result()

    def close(self) -> None:
        """Ends the helpers; calling it twice does no harm."""
        if self._helpers is not None:
            self._helpers.shutdown()
