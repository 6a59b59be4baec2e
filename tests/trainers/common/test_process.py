from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[3]
FAULTS = """
import os, resource, sys
from trainers.common.process import prepare
if sys.argv[1] == "prepared":
    prepare()
import numpy as np
def use():
    parts = [np.ones(2_500_000) for _ in range(4)]  # 20 MB each
for _ in range(3):
    use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    use()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before, os.environ["OMP_WAIT_POLICY"])
"""


def faults(how: str, policy: str) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-c", FAULTS, how],
        capture_output=True,
        text=True,
        check=True,
        cwd=REPOSITORY,
        env={"PATH": "/usr/bin:/bin", "OMP_WAIT_POLICY": policy},
    )
    count, waiting = done.stdout.split()
    return int(count), waiting


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc alone has mallopt")
def test_freed_memory_is_not_mapped_anew() -> None:
    # 20 rounds of 80 MB are 400,000 pages of 4 KiB.
    assert faults("prepared", "ACTIVE")[0] < 4_000


def test_what_the_user_set_of_threads_stays() -> None:
    assert faults("prepared", "ACTIVE")[1] == "ACTIVE"
