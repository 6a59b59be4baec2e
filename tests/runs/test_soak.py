"""Runs for hours: memory, files and descriptors stay where they were when all was warm."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[2]
WriteRun = Callable[..., Path]
INTERVAL_S = 2.0
WARM = 0.3
"""Part of the run after which nothing grows."""
GROWTH = {"memory_mib": 16.0, "descriptors": 2, "files": 9, "checkpoint_bytes": 2**16}
"""What comes and goes: files of a checkpoint that is written (4), of the best one where that is
older than the kept ones (4), the policy's description; episodes that wait."""

ENDLESS = """
import gymnasium
import numpy as np
from gymnasium.spaces import Box


class Endless(gymnasium.Env):
    observation_space = Box(-1.0, 1.0, (3,), np.float32)
    action_space = Box(-1.0, 1.0, (64,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        return self.np_random.uniform(-1.0, 1.0, 3).astype(np.float32), 0.0, False, False, {}


gymnasium.register("Endless-v0", entry_point=Endless)
"""
GRASP = {
    "type": "grasp",
    "simulator": "fast",
    "num_envs": 32,
    "cameras": {"depth": {"type": "depth", "width": 32, "height": 32}},
}
PPO = {"hyperparameters": {"buffer_size": 2048, "batch_size": 512, "num_epoch": 1}}


@dataclass(frozen=True)
class Sample:
    """Size of a run at a moment."""

    step: int
    memory_mib: float
    descriptors: int
    files: int
    checkpoint_bytes: int


def sampled(process: subprocess.Popen[bytes], run: Path) -> Sample | None:
    """None where the run is no more, or has not begun."""
    try:
        own = Path(f"/proc/{process.pid}")
        memory = (own / "statm").read_text().split()[1]
        checkpoints = [p for p in run.glob("checkpoints/*/*") if p.is_file()]
        return Sample(
            json.loads((run / "status.json").read_text())["step"],
            int(memory) * os.sysconf("SC_PAGE_SIZE") / 2**20,
            len(list((own / "fd").iterdir())),
            sum(len(files) for _, _, files in os.walk(run)),
            max((p.stat().st_size for p in checkpoints), default=0),
        )
    except (FileNotFoundError, ProcessLookupError):
        return None


def soaked(config: Path, folder: Path) -> list[Sample]:
    """Samples of a run from its beginning to its end."""
    command = [sys.executable, "-m", "trainers.learn", str(config)]
    paths = {"PYTHONPATH": f"{REPOSITORY}{os.pathsep}{folder}"}
    with (folder / "log.txt").open("wb") as log:
        process = subprocess.Popen(
            command, cwd=folder, env={**os.environ, **paths}, stdout=log, stderr=log
        )
        samples = []
        while process.poll() is None:
            samples.append(sampled(process, folder / "results" / config.stem))
            time.sleep(INTERVAL_S)
    assert process.returncode == 0, (folder / "log.txt").read_text()
    return [sample for sample in samples if sample is not None]


@pytest.mark.soak
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    ("steps", "environment"),
    [
        pytest.param(
            1_000_000, {"type": "gymnasium", "id": "CartPole-v1", "num_envs": 8}, id="cart pole"
        ),
        pytest.param(200_000, GRASP, id="grasp"),
        pytest.param(200_000, {"type": "gymnasium", "id": "endless:Endless-v0"}, id="endless"),
    ],
)
def test_a_long_run_stays_as_big_as_it_was(
    write_run: WriteRun, tmp_path: Path, steps: int, environment: dict[str, Any]
) -> None:
    (tmp_path / "endless.py").write_text(ENDLESS)
    trainer = {**PPO, "max_steps": steps, "summary_freq": steps // 100}
    rewards = [{"type": "touch"}, {"type": "collision"}] if environment is GRASP else []
    config = write_run(
        environment, {**trainer, "checkpoint_interval": steps // 50}, rewards=rewards
    )
    samples = soaked(config, tmp_path)
    warm = [sample for sample in samples if sample.step > WARM * steps]
    half = len(warm) // 2
    before, after = warm[:half], warm[half:]
    print(*samples[:: max(len(samples) // 20, 1)], sep="\n")
    for field, allowed in GROWTH.items():
        most = [max(getattr(sample, field) for sample in part) for part in (before, after)]
        assert most[1] <= most[0] + allowed, f"{field} grew from {most[0]} to {most[1]}"
