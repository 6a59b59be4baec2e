"""What a whole training process costs: memory, and the time until it is under way.

Each is measured in a process of its own, which this module is the main of.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.speed.figures import MODES, OURS
from benchmarks.speed.setup import Setup

REPOSITORY = Path(__file__).parents[2]
RUN_FILE = REPOSITORY / "config" / "run.yaml"
BUFFERS = 2
KIB_PER_MIB = 1024


@dataclass(frozen=True)
class Footprint:
    """The most memory a training process had resident.

    Attributes:
        contender: who trained.
        size: side of the images in pixels.
        mode: one of `benchmarks.speed.figures.MODES`.
        peak_mib: peak resident set in MiB.
    """

    contender: str
    size: int
    mode: str
    peak_mib: float


def footprints(
    setup: Setup, contenders: Sequence[str], modes: Iterable[str] = tuple(MODES)
) -> list[Footprint]:
    """Measures the peak resident set of each contender, over `BUFFERS` buffers."""
    found = []
    for mode in modes:
        for name in contenders:
            peak_mib = _ask("learn", name, str(setup.size), mode, str(setup.num_envs))
            found.append(Footprint(name, setup.size, mode, peak_mib))
    return found


def start_s() -> float:
    """Seconds from the start of `trainers.learn` on the main job to its first step, all compiled.

    It is started twice, so that the second start finds the compiled kernels.
    """
    for _ in range(2):
        begun_s = time.monotonic()
        first_step_s = _ask("start")
    return first_step_s - begun_s


def _ask(*arguments: str) -> float:
    """The number that such a process prints last."""
    process = subprocess.run(
        [sys.executable, "-m", __name__, *arguments],
        capture_output=True,
        cwd=REPOSITORY,
        text=True,
        check=False,
    )
    if process.returncode != 0:
        raise RuntimeError(f"measuring {' '.join(arguments)!r} failed:\n{process.stderr}")
    return float(process.stdout.split()[-1])


def _learn(name: str, size: int, mode: str, num_envs: int) -> float:
    """Trains for a while; returns the peak resident set of this process in MiB."""
    # Each process loads its own contender alone.
    from benchmarks.speed.training import contenders  # noqa: PLC0415

    setup = Setup(size=size, mode=mode, num_envs=num_envs)
    contender = contenders(peer=name != OURS)[name](setup)
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


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["learn", name, size, mode, num_envs]:
            print(_learn(name, int(size), mode, int(num_envs)))
        case _:
            print(first_step_time_s())
