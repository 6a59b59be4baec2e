"""Memory: what arrays of many environments take, and what the machine has."""

from __future__ import annotations

import math
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from trainers.common.cores import local_ranks

CONTAINER_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
"""Where a container's control group says how much memory it may have: of version 2 and of 1."""


def machine_bytes() -> int:
    """Bytes that this process may have: the machine's, its container's or its own limit's."""
    known = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    own, _ = resource.getrlimit(resource.RLIMIT_AS)
    if own != resource.RLIM_INFINITY:
        known.append(own)
    for path in CONTAINER_LIMITS:
        text = path.read_text().strip() if path.is_file() else ""
        if text.isdigit():  # "max" where there is none
            known.append(int(text))
    return min(known)


_needs: ContextVar[dict[str, float] | None] = ContextVar("memory_needs", default=None)


@contextmanager
def adding_up() -> Iterator[dict[str, float]]:
    """Adds up what memory is asked about meanwhile: bytes by what they are for."""
    needs: dict[str, float] = {}
    token = _needs.set(needs)
    try:
        yield needs
    finally:
        _needs.reset(token)


def shortage(needed_bytes: float, purpose: str) -> str | None:
    """In words, that the machine has not got so much memory; None where it has.

    Args:
        needed_bytes: how much, in each of the processes that torchrun has started here.
        purpose: what it is for; see `adding_up`.
    """
    needed_bytes *= local_ranks()
    needs = _needs.get()
    if needs is not None:
        needs[purpose] = needs.get(purpose, 0.0) + needed_bytes
    has = machine_bytes()
    if needed_bytes <= has:
        return None
    return f"needs {_gb(needed_bytes)}, and the machine has {_gb(has)}"


def _gb(count: float) -> str:
    return f"{count / 1e9:,.{1 if count >= 1e8 else 2}f} GB"


def space_bytes(space: gymnasium.Space[Any]) -> int:
    """Bytes of one element of a space, or of all that are in a space of spaces."""
    if isinstance(space, gymnasium.spaces.Dict):
        return sum(map(space_bytes, space.spaces.values()))
    return math.prod(space.shape or ()) * np.dtype(space.dtype).itemsize
