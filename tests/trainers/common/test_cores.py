"""Cores of the affinity and of a container's quota, on made-up and on real control groups."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from trainers.common import cores, process
from trainers.common.cores import quota, usable_cores

V1_LINES = "4:memory:/user.slice\n3:cpu,cpuacct:{}\n2:cpuset:/\n"
Groups = Callable[..., None]


@pytest.fixture(autouse=True)
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Groups:
    """Lays out control groups: `groups("0::/a", {"a/cpu.max": "50000 100000"})`."""
    monkeypatch.setattr(cores, "OWN", tmp_path / "own")
    monkeypatch.setattr(cores, "CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)

    def lay_out(own: str, files: dict[str, str]) -> None:
        (tmp_path / "own").write_text(own)
        for name, content in files.items():
            path = tmp_path / "cgroup" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{content}\n")

    return lay_out


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"cpu.max": "250000 100000"}, 2.5),
        ("0::/\n", {"cpu.max": "max 100000"}, math.inf),
        ("0::/\n", {"cpu.weight": "100"}, math.inf),
        # The least of a group's own and of those that it is in.
        ("0::/a/b\n", {"a/cpu.max": "200000 100000", "a/b/cpu.max": "max 100000"}, 2.0),
        ("0::/a/b\n", {"a/cpu.max": "200000 100000", "a/b/cpu.max": "20000 50000"}, 0.4),
        ("0::/a\n", {"a/b/cpu.max": "100000 100000"}, math.inf),
        # In a container that sees its own group as the root, under the name that the host has.
        ("0::/docker/4f2e\n", {"cpu.max": "300000 100000"}, 3.0),
        (
            V1_LINES.format("/kubepods/pod7"),
            {
                "cpu,cpuacct/kubepods/cpu.cfs_quota_us": "-1",
                "cpu,cpuacct/kubepods/cpu.cfs_period_us": "100000",
                "cpu,cpuacct/kubepods/pod7/cpu.cfs_quota_us": "150000",
                "cpu,cpuacct/kubepods/pod7/cpu.cfs_period_us": "100000",
                "memory/user.slice/cpu.max": "1 100000",
            },
            1.5,
        ),
        (V1_LINES.format("/"), {"cpu,cpuacct/cpu.cfs_quota_us": "-1"}, math.inf),
    ],
)
def test_the_quota_is_what_the_control_groups_say(
    groups: Groups, own: str, files: dict[str, str], expected: float
) -> None:
    groups(own, files)
    assert quota() == expected


def test_where_there_are_no_control_groups_there_is_no_quota() -> None:
    assert quota() == math.inf


@pytest.mark.parametrize(
    ("content", "expected"),
    [("max 100000", 16), ("3200000 100000", 16), ("250000 100000", 3), ("10000 100000", 1)],
)
def test_threads_are_no_more_than_the_quota_buys(
    groups: Groups, content: str, expected: int
) -> None:
    groups("0::/\n", {"cpu.max": content})
    assert usable_cores() == expected


@pytest.mark.parametrize(("ranks", "expected"), [("2", 8), ("3", 6), ("64", 1)])
def test_processes_of_torchrun_share_the_cores(
    monkeypatch: pytest.MonkeyPatch, ranks: str, expected: int
) -> None:
    monkeypatch.setenv("LOCAL_WORLD_SIZE", ranks)
    assert usable_cores() == expected


def test_without_an_affinity_all_cores_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 10)
    assert usable_cores() == 10


@pytest.mark.parametrize(
    ("content", "given", "expected"),
    [("max 100000", None, None), ("250000 100000", None, "3"), ("250000 100000", "1", "1")],
)
def test_torch_is_told_of_a_quota_which_it_does_not_look_for(
    groups: Groups,
    monkeypatch: pytest.MonkeyPatch,
    content: str,
    given: str | None,
    expected: str | None,
) -> None:
    groups("0::/\n", {"cpu.max": content})
    environment = {} if given is None else {"OMP_NUM_THREADS": given}
    monkeypatch.setattr(os, "environ", environment)
    process.prepare()
    assert environment.get("OMP_NUM_THREADS") == expected


def test_threads_and_jobs_are_as_many_as_the_affinity_has() -> None:
    """As under `taskset`."""
    code = (
        "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); "
        "from envs.grasp.simulators.thread_pool import ThreadPool; "
        "from trainers.comparison.jobs import CORES; "
        "print(os.cpu_count() > 1, ThreadPool()._threads, CORES)"
    )
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert printed.split()[1:] == ["1", "1"]


def test_a_job_has_one_thread_in_compiled_loops_too() -> None:
    """`compare` and `sweep` say so by numba's variable, whatever the number of cores."""
    code = "from envs.grasp.simulators.thread_pool import ThreadPool; print(ThreadPool()._threads)"
    environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
    assert subprocess.check_output([sys.executable, "-c", code], env=environment) == b"1\n"
