"""What a whole training process costs: memory, and the time until it is under way.

Each is measured in a process of its own, which loads nothing but what it needs.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.command import ROOT

RUN_FILE = ROOT / "config" / "run.yaml"
BUFFERS = 2
KIB_PER_MIB = 1024


def peak_mib(contender: str, size: int, mode: str, num_envs: int) -> float:
    """The most memory that a contender has resident while it trains on `BUFFERS` buffers, in MiB.

    Args:
        contender: one of `benchmarks.speed.training.contenders`.
        size: side of the images in pixels.
        mode: one of `benchmarks.speed.figures.MODES`.
        num_envs: environments stepped together.
    """
    return _ask("own_peak_mib", contender, size, mode, num_envs)


def start_s() -> float:
    """Seconds from the start of `trainers.learn` on the main job to its first step, all compiled.

    It is started twice, so that the second start finds the compiled kernels.
    """
    for _ in range(2):
        begun_s = time.monotonic()
        first_step_s = _ask("first_step_time_s")
    return first_step_s - begun_s


def _ask(function: str, *arguments: Any) -> float:
    """What a function of this module returns in a process of its own."""
    call = f"import {__name__} as here; print(here.{function}(*{arguments!r}))"
    process = subprocess.run(
        [sys.executable, "-c", call], capture_output=True, cwd=ROOT, text=True, check=False
    )
    if process.returncode != 0:
        raise RuntimeError(f"measuring {function}{arguments} failed:\n{process.stderr}")
    return float(process.stdout.split()[-1])


def own_peak_mib(name: str, size: int, mode: str, num_envs: int) -> float:
    """The same of this process."""
    from benchmarks.speed.figures import OURS  # noqa: PLC0415
    from benchmarks.speed.training import contenders, load  # noqa: PLC0415

    contender = contenders(peer=name != OURS)[name](load(size, mode, num_envs))
    for _ in range(BUFFERS):
        contender.learn()
    contender.close()
    # Not getrusage's ru_maxrss, which begins with the parent's: this one begins at exec.
    status = Path("/proc/self/status").read_text()
    peak_kib = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
    return int(peak_kib) / KIB_PER_MIB


def first_step_time_s() -> float:
    """Begins the main job on the fast simulator; returns when its first step was done."""
    from trainers.learn import parse  # noqa: PLC0415
    from trainers.run import run_file  # noqa: PLC0415

    asked_s: list[float] = []

    def after_one_step() -> bool:
        asked_s.append(time.monotonic())
        return len(asked_s) > 1

    with tempfile.TemporaryDirectory() as folder:
        options = parse(
            [str(RUN_FILE), "environment.simulator=fast", "--num-envs=256", "--results-dir", folder]
        )
        run_file(options, after_one_step)
    return asked_s[-1]
