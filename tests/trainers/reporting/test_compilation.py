"""That kernels are compiled is told once, and where it is so alone."""

from __future__ import annotations

import numba

from trainers.reporting.compilation import NOTICE, telling_of_compilation


def test_it_is_told_once() -> None:
    first, second = numba.njit(lambda x: x + 1), numba.njit(lambda x: x + 2)
    told: list[str] = []
    with telling_of_compilation(told.append) as compilation:
        assert told == []
        assert first(1) + second(1) == 5
        assert told == [NOTICE]
    assert compilation.happened
    with telling_of_compilation(told.append) as again:
        first(2)
    assert not again.happened
    assert told == [NOTICE]
