"""Runs of several processes, started by torchrun."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from safetensors.torch import load_file

from trainers.learn import main

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 300.0
RUN = {
    "environment": {"type": "gymnasium", "id": "CartPole-v1", "num_envs": 4},
    "trainer": {
        "trainer_type": "ppo",
        "max_steps": 128,
        "summary_freq": 64,
        "checkpoint_interval": 64,
        "hyperparameters": {"batch_size": 16, "buffer_size": 32, "num_epoch": 2},
        "network_settings": {"hidden_units": 8, "num_layers": 1, "normalize": True},
    },
    "evaluation": {"interval": 64, "episodes": 2},
}


@pytest.fixture
def run_path(tmp_path: Path) -> Path:
    path = tmp_path / "cart.yaml"
    path.write_text(yaml.safe_dump(RUN))
    return path


def torchrun(run_path: Path, *arguments: str, restarts: int = 0) -> subprocess.Popen[str]:
    """Two processes that train; their output is in `stdout`."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    rendezvous = ["--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0"]
    learn = ["-m", "trainers.learn", str(run_path), "--results-dir", str(run_path.parent)]
    return subprocess.Popen(
        [*launch, *rendezvous, "--max-restarts", str(restarts), *learn, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def status(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "status.json").read_text())
    return content


def test_two_processes_write_the_run_of_one(run_path: Path) -> None:
    process = torchrun(run_path, "--run-id", "two")
    output, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, output
    assert output.count("two: to step 128") == 1
    assert main([str(run_path), "--run-id", "one", "--results-dir", str(run_path.parent)]) == 0
    one, two = (run_path.parent / name for name in ("one", "two"))
    for step in (64, 128):
        expected = load_file(one / f"checkpoints/step-{step}/weights.safetensors")
        weights = load_file(two / f"checkpoints/step-{step}/weights.safetensors")
        assert max(float((weights[k] - expected[k]).abs().max()) for k in expected) < 1e-5
    assert status(two)["state"] == "finished"
    assert status(two)["reward"] == pytest.approx(status(one)["reward"])
    assert status(two)["evaluation"] == status(one)["evaluation"]
    names = [{path.name for path in folder.iterdir()} for folder in (one, two)]
    assert {n for n in names[0] if "events" not in n} == {n for n in names[1] if "events" not in n}


def killed(run_path: Path, process: subprocess.Popen[str], name: str) -> None:
    """Kills the second rank once something is saved."""
    folder = run_path.parent / name
    deadline = time.monotonic() + TIMEOUT_S
    while not (folder / "checkpoints/latest.json").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ranks = {
        re.search(rb"\0RANK=(\d)\0", Path(f"/proc/{pid}/environ").read_bytes())[1]: int(pid)  # type: ignore[index]
        for pid in children
    }
    os.kill(ranks[b"1"], signal.SIGKILL)


@pytest.mark.soak
def test_a_rank_that_is_killed_ends_the_run_with_its_name(run_path: Path) -> None:
    process = torchrun(run_path, "--run-id", "killed", "trainer.max_steps=1000000")
    killed(run_path, process, "killed")
    begin = time.monotonic()
    output, _ = process.communicate(timeout=TIMEOUT_S)
    assert time.monotonic() - begin < 60.0
    assert re.search(r"error: lost rank 1 \(.*, \d+\), which died or has not answered", output)
    assert status(run_path.parent / "killed")["state"] == "failed"
    assert "lost rank 1" in status(run_path.parent / "killed")["reason"]


@pytest.mark.soak
def test_torchrun_starts_a_run_again_where_it_was_saved(run_path: Path) -> None:
    process = torchrun(run_path, "--run-id", "again", "trainer.max_steps=4096", restarts=1)
    killed(run_path, process, "again")
    output, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, output
    assert "again: from step" in output
    assert status(run_path.parent / "again")["state"] == "finished"


@pytest.mark.soak
def test_a_mistake_is_told_once(run_path: Path) -> None:
    output, _ = torchrun(run_path, "--num-envs", "3").communicate(timeout=TIMEOUT_S)
    told = "error: environment.num_envs: 3 environments can't be divided among the 2 ranks evenly"
    assert output.count(told) == 1


@pytest.mark.soak
def test_sigterm_stops_all_ranks_and_saves_once(run_path: Path) -> None:
    process = torchrun(run_path, "--run-id", "term", "trainer.max_steps=1000000")
    folder = run_path.parent / "term"
    deadline = time.monotonic() + TIMEOUT_S
    while not (folder / "checkpoints/latest.json").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    process.terminate()
    output, _ = process.communicate(timeout=TIMEOUT_S)
    assert output.count("stopped, and saved") == 1
    assert status(folder)["state"] == "interrupted"
