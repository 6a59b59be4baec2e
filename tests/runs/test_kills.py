"""Runs that are killed at any moment go on as if they had not been, and leave nobody behind."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from trainers.loggers.event_files import PATTERN
from trainers.saving.checkpoint import Checkpoints, Loaded
from trainers.saving.run_lock import LOCK

REPOSITORY = Path(__file__).parents[2]
STEPS, INTERVAL, SUMMARIES_EACH = 1536, 64, 4
LATEST_KILL_S, IN_PEACE_S = 2.0, 600.0
ORPHANS_END_IN_S = 5.0
OF_THE_CLOCK = ("Performance/", "_hparams_/")
PENDULUM = {"type": "gymnasium", "id": "Pendulum-v1", "num_envs": 4, "vectorization": "async"}
GRASP = {
    "type": "grasp",
    "num_envs": 4,
    "episode_steps": 3,
    "cameras": {"depth": {"type": "depth", "width": 32, "height": 32}},
}
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "gymnasium": {"environment": PENDULUM},
    "fast": {
        "environment": {**GRASP, "simulator": "fast"},
        "rewards": [{"type": "touch"}, {"type": "approach"}],
    },
    "pybullet": {
        "environment": {**GRASP, "simulator": "pybullet", "workers": 2},
        "rewards": [{"type": "touch"}, {"type": "approach"}],
    },
}
HYPERPARAMETERS = {
    "ppo": {"buffer_size": 64},
    "trpo": {"buffer_size": 64},
    "ddpg": {"save_replay_buffer": True},
}
SOAKED = [
    pytest.param(algorithm, environment, 50, marks=pytest.mark.soak)
    for algorithm in HYPERPARAMETERS
    for environment in ENVIRONMENTS
]


def start(config: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Starts the command line in a session of its own, by which its processes are known."""
    return subprocess.Popen(
        [sys.executable, "-m", "trainers.learn", str(config), *arguments],
        cwd=config.parent,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def processes_of(session: int) -> list[int]:
    """Living processes of a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of = stat.read_text().rpartition(")")[2].split()[:4]
        except OSError:  # it has just ended
            continue
        if int(of) == session and state != "Z":
            found.append(int(stat.parent.name))
    return found


def killed(process: subprocess.Popen[bytes], has_begun: Callable[[], bool], wait_s: float) -> bool:
    """Kills a run that long after something has begun; False if it ended before, in peace."""
    while not has_begun() and process.poll() is None:
        time.sleep(0.01)
    try:
        _, errors = process.communicate(timeout=wait_s)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.communicate()
        return True
    assert process.returncode == 0, errors.decode()
    return False


def runs_with_kills(config: Path, kills: int, seed: int) -> Iterator[Path]:
    """Runs that came to their end after as many kills in all.

    Every other kill comes after a checkpoint of the process's own, however slow its start is; the
    rest at any moment from its lock on.
    """
    moments, resumed = random.Random(seed), 0
    for number in range(3 + kills):  # some may end before they are killed
        folder = config.parent / "results" / f"killed{number}"
        while True:
            before = checkpoints(folder)
            process = start(config, "--run-id", folder.name, "--resume" if before else "--force")
            resumed += bool(before)
            wait_s = moments.uniform(0.0, LATEST_KILL_S) if kills else IN_PEACE_S
            has_saved = partial(newly_saved, folder, before)
            has_begun = has_saved if kills % 2 else (folder / LOCK).exists
            if not killed(process, has_begun, wait_s):
                break
            kills -= 1
            deadline = time.monotonic() + ORPHANS_END_IN_S
            while orphans := processes_of(process.pid):
                assert time.monotonic() < deadline, orphans
                time.sleep(0.1)
        yield folder
        if not kills:
            assert resumed
            return
    raise AssertionError(f"{kills} kills came too late")


def checkpoints(folder: Path) -> set[str]:
    """Names of a run's checkpoints."""
    return {path.name for path in folder.glob("checkpoints/step-*")}


def newly_saved(folder: Path, before: set[str]) -> bool:
    """Whether a run has checkpoints that it had not before."""
    return bool(checkpoints(folder) - before)


def saved(folder: Path) -> Loaded:
    return Checkpoints(folder / "checkpoints", keep=9).load_latest()


def points(folder: Path) -> Counter[tuple[str, int, bytes]]:
    """How often each point of each curve stands in the run's event files, with its value."""
    return Counter(
        (
            value.tag,
            event.step,
            b"" if value.tag.startswith(OF_THE_CLOCK) else value.tensor.SerializeToString(),
        )
        for path in folder.glob(PATTERN)
        for event in EventFileLoader(str(path)).Load()
        for value in event.summary.value
        if value.tag != "configuration/text_summary"  # of every start
    )


@pytest.fixture
def config(write_run: Callable[..., Path], algorithm: str, environment: str) -> Path:
    parts = dict(ENVIRONMENTS[environment])
    trainer = {
        "trainer_type": algorithm,
        "max_steps": STEPS,
        "checkpoint_interval": INTERVAL,
        "summary_freq": SUMMARIES_EACH * INTERVAL,
        "hyperparameters": HYPERPARAMETERS[algorithm],
    }
    return write_run(parts.pop("environment"), trainer, **parts)


@pytest.mark.parametrize(("algorithm", "environment", "kills"), [("ppo", "gymnasium", 1), *SOAKED])
def test_a_killed_run_ends_as_one_that_was_not(config: Path, kills: int) -> None:
    assert start(config, "--run-id", "whole").wait() == 0
    whole = config.parent / "results" / "whole"
    expected, curves = saved(whole), points(whole)
    assert set(curves.values()) == {1}
    for folder in runs_with_kills(config, kills, seed=kills):
        assert points(folder) == curves
        for name in ("weights.safetensors", "state.safetensors", "state.json"):
            assert (saved(folder).path / name).read_bytes() == (expected.path / name).read_bytes()
