"""However a run ends: it is saved, says why, and has its exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import safetensors.torch
from torch.utils.tensorboard import SummaryWriter

from trainers import evaluate
from trainers import run as run_module
from trainers.algorithms.ppo import PPO
from trainers.common.options import version
from trainers.comparison.results import STATUS, read_status
from trainers.experience.env_runner import EnvRunner
from trainers.learn import main
from trainers.runfile.registry import load_registries

Learn = Callable[..., Any]
WriteRun = Callable[..., Path]
REPOSITORY = Path(__file__).parents[2]
CARTPOLE = {"type": "gymnasium", "id": "CartPole-v1", "num_envs": 2}
BREAKING = """
import sys
import numpy as np
from pydantic import BaseModel
from trainers.hookspecs import hookimpl


class Breaking:
    class Settings(BaseModel, frozen=True, extra="forbid"):
        leave: bool = False

    def __init__(self, settings):
        self.leave, self.calls = settings.leave, 0

    def __call__(self, transition):
        self.calls += 1
        if self.calls > 9:
            return sys.exit(0) if self.leave else self.rewards(transition, 0)
        return np.zeros(2)

    def rewards(self, transition, weight):
        return transition.rewards.sum().item() // weight


@hookimpl
def ventosa_rewards():
    return {"breaks": Breaking}
"""


@pytest.fixture(autouse=True)
def _not_under_nohup() -> Iterator[None]:
    """There runs ignore SIGHUP, as they should."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def last_checkpoint(done: Any) -> str:
    """What the status of a run says that it left."""
    return str(json.loads((done.results / "toy" / STATUS).read_text())["last_checkpoint"])


def at_call(
    monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, number: int, action: Callable[[], None]
) -> None:
    """Does something just before the nth call of a method from now."""
    method, calls = getattr(owner, name), iter(range(1, 10**6))

    def called(self: Any, *arguments: Any) -> Any:
        if next(calls) == number:
            action()
        return method(self, *arguments)

    monkeypatch.setattr(owner, name, called)


@pytest.mark.parametrize(
    ("leave", "reason", "line"),
    [
        (False, "ZeroDivisionError: float floor division by zero", ".sum().item() // weight"),
        (True, "SystemExit: 0", "return sys.exit(0) if self.leave"),
    ],
    ids=["raises", "leaves"],
)
def test_a_plugin_that_fails_is_named_with_its_lines_and_leaves_the_run_saved(
    learn: Learn,
    write_run: WriteRun,
    monkeypatch: pytest.MonkeyPatch,
    install_plugin: Callable[[str, str], Path],
    capfd: pytest.CaptureFixture[str],
    leave: bool,
    reason: str,
    line: str,
) -> None:
    install_plugin("reward_that_breaks", BREAKING)
    monkeypatch.setattr(run_module, "load_registries", load_registries)
    config = write_run(CARTPOLE, rewards=[{"type": "breaks", "leave": leave}])
    done = learn(config)
    assert done.code == 1
    failed = f"plugin 'own' (reward-that-breaks 1.2) failed: {reason}"
    saved = done.results / "toy/checkpoints/step-16"  # 8 steps of 2 environments
    said, *lines = done.errors.splitlines()
    assert said == f"error: {failed}; the last good checkpoint is {saved}"
    assert any(line in own for own in lines)
    assert len(lines) < 10
    assert "Traceback" not in done.errors
    status = read_status(done.results / "toy")
    assert (status["state"], f"error: {status['reason']}") == ("failed", said)
    assert last_checkpoint(done) == str(saved)
    assert evaluate.main(["toy", "--results-dir", str(done.results)]) == 1
    assert capfd.readouterr().err.startswith(f"error: {failed}\n")


def test_a_bug_of_ours_keeps_its_traceback_names_the_last_checkpoint_and_says_so_in_the_status(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail() -> None:
        raise KeyError("a bug")

    at_call(monkeypatch, PPO, "update", 3, fail)
    with pytest.raises(KeyError) as failed:
        learn(write_run())
    last = f"the last good checkpoint is {tmp_path / 'results/toy/checkpoints/step-32'}"
    assert failed.value.__notes__ == [last]
    status = read_status(tmp_path / "results/toy")
    assert (status["state"], status["reason"]) == ("failed", f"KeyError: 'a bug'; {last}")


@pytest.mark.parametrize("owner", [PPO, EnvRunner], ids=["update", "collection"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=["sigterm", "sighup"])
def test_a_signal_is_heard_in_updates_as_in_collections(
    learn: Learn,
    write_run: WriteRun,
    monkeypatch: pytest.MonkeyPatch,
    owner: type,
    number: signal.Signals,
) -> None:
    name, calls = ("_optimizer_step", 5) if owner is PPO else ("step", 11)
    at_call(monkeypatch, owner, name, calls, lambda: os.kill(os.getpid(), number))
    done = learn(write_run(), "trainer.checkpoint_interval=1000")
    assert done.code == 143
    assert done.step == 32  # before the third collection, and its update
    assert read_status(done.results / "toy")["state"] == "interrupted"


def test_the_second_signal_ends_a_run_at_once(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    def insist() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)

    at_call(monkeypatch, EnvRunner, "step", 11, insist)
    done = learn(write_run(), "trainer.checkpoint_interval=1000")
    assert done.code == 143
    assert done.checkpoints == []
    status = read_status(done.results / "toy")
    assert status["state"] == "interrupted"
    assert status["reason"] == "stopped at once; no checkpoint was saved yet"


def test_a_log_that_can_not_be_written_is_told_once_and_the_run_goes_on(
    learn: Learn,
    write_run: WriteRun,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(SummaryWriter, "add_scalar", fail)
    done = learn(write_run())
    assert (done.code, done.step) == (0, 64)
    assert read_status(done.results / "toy")["state"] == "finished"
    assert sum("the log can't be written" in message for message in caplog.messages) == 1


def test_a_full_disk_ends_a_run_in_a_line_with_the_checkpoint_that_is_left(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(28, "No space left on device")
    save_file = safetensors.torch.save_file
    results = iter([save_file])  # the disk has room for one

    def save(*arguments: Any) -> None:
        next(results, Mock(side_effect=full))(*arguments)

    monkeypatch.setattr(safetensors.torch, "save_file", save)
    done = learn(write_run())
    folder = done.results / "toy/checkpoints"
    told = f"{folder / 'step-64'}: cannot write: No space left on device"
    left = f"the last good checkpoint is {folder / 'step-32'}"
    assert (done.code, done.errors) == (1, f"error: {told}; {left}\n")
    status = read_status(done.results / "toy")
    assert (status["state"], status["reason"]) == ("failed", f"{told}; {left}")
    assert [path.name for path in done.checkpoints] == ["step-32"]


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_run_that_was_killed_is_not_running_for_ever(write_run: WriteRun, learn: Learn) -> None:
    config = write_run("target", {"max_steps": 10**9})
    results = config.parent / "results"
    child = os.fork()
    if child == 0:
        try:
            main([str(config), "--results-dir", str(results)])
        finally:  # never back into pytest
            os._exit(99)
    until((results / "toy/status.json").exists)
    assert read_status(results / "toy")["state"] == "running"
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert json.loads((results / "toy/status.json").read_text())["state"] == "running"
    assert read_status(results / "toy")["state"] == "interrupted"


def test_a_closed_output_and_the_end_of_the_terminal_lose_nothing(
    write_run: WriteRun, tmp_path: Path
) -> None:
    config = write_run(CARTPOLE, {"max_steps": 10**9})
    process = subprocess.Popen(
        [sys.executable, "-m", "trainers.learn", str(config)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline() == f"{version()}: {config}\n"
    process.stdout.close()  # as `| head -1` does
    run = tmp_path / "results/toy"
    latest = run / "checkpoints/latest.json"
    until(lambda: latest.exists() and json.loads(latest.read_text())["step"] >= 256)
    process.send_signal(signal.SIGHUP)
    assert "Error" not in process.stderr.read()
    assert process.wait(timeout=120) == 143
    assert read_status(run)["reason"] == "stopped, and saved"
    assert read_status(run)["step"] >= 256
