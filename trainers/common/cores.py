"""Processor cores that this process may use, which can be fewer than the machine has."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")
V2_QUOTA = "cpu.max"
V1_QUOTA, V1_PERIOD = "cpu.cfs_quota_us", "cpu.cfs_period_us"


def usable_cores() -> int:
    """Threads that can run at once: one a core of the affinity, within a container's quota.

    The processes that torchrun has started on this machine share them. A part of a core counts as
    one: a thread that is held up now and then is better than a share of the quota that nobody uses.
    """
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        allowed = len(os.sched_getaffinity(0))
    else:
        allowed = os.cpu_count() or 1
    return math.ceil(min(allowed, quota()) / local_ranks())


def local_ranks() -> int:
    """Processes of one run on this machine, as torchrun says."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def quota() -> float:
    """Cores' worth of time that a container may take, by Linux's control groups; or infinity.

    A group is limited by its own quota and by those of all that it is in.
    """
    return min((quota for group in _groups() for quota in _quotas(group)), default=math.inf)


def _groups() -> Iterator[Path]:
    """Folders of the control groups, of version 1 or 2, that this process is in."""
    try:
        lines = OWN.read_text().splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        # In a container the name may be that on the host, and the first folder the container's.
        group = CGROUPS / controllers
        yield group
        for part in Path(name).parts[1:]:
            group /= part
            yield group


def _quotas(group: Path) -> Iterator[float]:
    """The quota of a control group, in cores, if it has one.

    See the Linux kernel's documentation: cgroup-v2 `cpu.max`, sched-bwc `cpu.cfs_quota_us`.
    """
    try:
        if (group / V2_QUOTA).is_file():
            amount, period = (group / V2_QUOTA).read_text().split()
        else:
            amount, period = ((group / file).read_text() for file in (V1_QUOTA, V1_PERIOD))
        if amount != "max" and int(amount) > 0:
            yield int(amount) / int(period)
    except OSError:
        return
