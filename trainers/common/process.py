"""Settings of the process that a policy learns or is judged in, made before torch is imported."""

from __future__ import annotations

import ctypes
import math
import os

from trainers.common.cores import quota, usable_cores

# glibc's names in malloc.h, and the highest threshold that it takes.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
LARGEST_MMAP_THRESHOLD = 32 * 2**20
KEPT_BYTES = 2**31 - 1


def prepare() -> None:
    """Lets idle threads sleep, and freed memory stay with the process.

    torch's threads would otherwise spin while they wait, on the cores that simulate. And the
    activations of a batch, some ten megabytes each, are freed and taken again in every optimizer
    step: where glibc gives them back to the system in between, every page of them is mapped and
    zeroed anew, which can cost a third of an update. Other C libraries are left alone.

    torch has a thread for every core that it sees, also where a container may not use them all: it
    would be stopped in the middle of an update until its next share of time.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if math.isfinite(quota()):
        os.environ.setdefault("OMP_NUM_THREADS", str(usable_cores()))
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_MMAP_THRESHOLD)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
