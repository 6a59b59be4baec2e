"""Sweeps of several processes, and what is left of those that are killed."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import optuna
import pytest
from optuna.trial import FrozenTrial, TrialState

RUN = """
environment: {type: gymnasium, id: CartPole-v1, num_envs: 2}
trainer:
  trainer_type: ppo
  max_steps: 2000
  summary_freq: 200
  hyperparameters: {buffer_size: 64, batch_size: 32, num_epoch: 1}
  network_settings: {hidden_units: 8, num_layers: 1}
evaluation: {interval: 500, episodes: 2}
"""
SWEEP = """
run: run.yaml
space:
  trainer.hyperparameters.learning_rate: {choice: [1e-3, 1e-2]}
  seed: {choice: [0, 1]}
sampler: grid
pruner: none
"""


@pytest.fixture
def sweep_file(tmp_path: Path) -> Path:
    (tmp_path / "run.yaml").write_text(RUN)
    (tmp_path / "pole.yaml").write_text(SWEEP)
    return tmp_path / "pole.yaml"


def begin(sweep_file: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "trainers.sweep", str(sweep_file), "--jobs", "1", *words]
    results = ["--results-dir", str(sweep_file.parent / "results")]
    return subprocess.Popen(command + results, stdout=subprocess.PIPE, text=True)


def trials_of(sweep_file: Path) -> list[FrozenTrial]:
    journal = sweep_file.parent / "results" / "pole" / "study.journal"
    storage = optuna.storages.JournalStorage(
        optuna.storages.journal.JournalFileBackend(str(journal))
    )
    found: list[FrozenTrial] = optuna.load_study(study_name="pole", storage=storage).get_trials()
    return found


@pytest.mark.soak
def test_processes_share_a_sweep(sweep_file: Path) -> None:
    processes = [begin(sweep_file) for _ in range(2)]
    said = [process.communicate()[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    trials = trials_of(sweep_file)
    assert {trial.state for trial in trials} == {TrialState.COMPLETE}
    cells = {tuple(trial.params.values()) for trial in trials}
    assert len(cells) == 4
    assert len(trials) in (4, 5)  # they may ask for the last one together
    assert all("begins" in text for text in said)


@pytest.mark.soak
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_sweep_that_was_ended_goes_on(sweep_file: Path, number: signal.Signals) -> None:
    run_file = sweep_file.parent / "run.yaml"
    run_file.write_text(RUN.replace("max_steps: 2000", "max_steps: 20000"))
    begun = begin(sweep_file, "--trials", "1")
    run = sweep_file.parent / "results" / "pole" / "trial-0000"
    while not (run / "status.json").exists():
        assert begun.poll() is None
        time.sleep(0.05)
    begun.send_signal(number)
    begun.communicate()
    (left,) = trials_of(sweep_file)
    assert left.state is TrialState.RUNNING
    deadline = time.monotonic() + 120.0
    while (run / "run.lock").exists():  # what outlives a sweep that was killed
        assert time.monotonic() < deadline
        time.sleep(0.1)
    again = begin(sweep_file, "--trials", "1")
    again.communicate()
    assert again.returncode == 0
    (ended,) = trials_of(sweep_file)
    assert ended.state is TrialState.COMPLETE
    assert len(ended.intermediate_values) == 40
