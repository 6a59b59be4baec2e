"""Processes that end with the one that started them."""

from __future__ import annotations

import ctypes
import signal

PR_SET_PDEATHSIG = 1  # Linux's, in linux/prctl.h


def end_with_parent() -> None:
    """Lets the system kill this process when its parent ends, whatever either is doing.

    On systems other than Linux nothing happens.
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
