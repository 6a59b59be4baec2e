"""Whole runs whose environment fails in every way it can: said plainly, saved, nothing left over.

All faults at all times are a soak; a sample of them is always run.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete

from envs.gym import processes
from envs.gym.episodes import episode_seed
from trainers.common import stopping

Learn = Callable[..., Any]
WriteRun = Callable[..., Path]
Returned = tuple[Any, ...]
ENV_ID = "ventosa_tests/Faulty-v0"
HUNG = "VENTOSA_TESTS_HUNG"
"""Variable with the file that is written when an environment hangs."""
NUM_ENVS, BUFFER_STEPS = 2, 16
FAULTY = 1
"""The environment that fails; the other one does not."""
RESET, FIRST, LATER = 0, 1, 50
"""Steps in which it does."""


def raises(error: BaseException) -> Callable[[Returned], Returned]:
    def fault(good: Returned) -> Returned:
        raise error

    return fault


def entry(name: str, value: Any) -> Callable[[Returned], Returned]:
    """Returns another value in the observation."""
    return lambda good: ({**good[0], name: value}, *good[1:])


def result(position: int, value: Any) -> Callable[[Returned], Returned]:
    """Returns another value in the place of a result."""
    return lambda good: tuple(value if i == position else v for i, v in enumerate(good))


class Unpicklable(Exception):  # noqa: N818
    """Can't be built again from what it was built from."""

    def __init__(self, first: int, second: int):
        super().__init__("unpicklable")


def hang(good: Returned) -> Returned:
    while True:
        with contextlib.suppress(Exception):
            time.sleep(3600.0)


def hang_while_stopping(good: Returned) -> Returned:
    """Hangs where a SIGTERM has reached the learner."""
    learner = multiprocessing.parent_process()
    Path(os.environ[HUNG]).touch()
    os.kill(os.getpid() if learner is None else learner.pid, signal.SIGTERM)
    return hang(good)


def deep(good: Returned) -> Returned:
    return deep(good)


ARRAY = r"an array of float32 \(2,\)"
ANYWHERE: dict[str, tuple[Any, str]] = {
    "runtime error": (raises(RuntimeError("the room collapsed")), "RuntimeError: the room coll"),
    "no message": (raises(AssertionError()), r"AssertionError \("),
    "key error": (raises(KeyError("door")), "KeyError: 'door'"),
    "division": (lambda good: (1 // 0,), "ZeroDivisionError: integer division"),
    "out of memory": (raises(MemoryError("full")), "MemoryError: full"),
    "no more": (raises(StopIteration()), "StopIteration"),
    "end of file": (raises(EOFError("socket")), "EOFError: socket"),
    "connection": (raises(ConnectionResetError("simulator")), "ConnectionResetError: simulator"),
    "os error": (raises(FileNotFoundError(2, "No such file", "a.xml")), "No such file: 'a.xml'"),
    "unpicklable": (raises(Unpicklable(1, 2)), "Unpicklable: unpicklable"),
    "recursion": (deep, "RecursionError: maximum recursion"),
    "exit": (lambda good: sys.exit(3), "SystemExit: 3"),
    "nothing": (lambda good: None, "tuple|NoneType"),
    "a list": (list, "a tuple|not a tuple|tuple, actual"),
    # In a first step gymnasium takes four for what its environments once returned.
    "too few": (lambda good: good[:-1], r"a tuple|expected \d|dictionary"),
    "too many": (lambda good: (*good, None), r"a tuple|expected \d|four or five"),
    "no observation": (result(0, None), "dict"),
    "an array": (result(0, np.zeros(2)), "dict"),
    "missing key": (lambda good: ({"x": good[0]["x"]}, *good[1:]), "keys"),
    "wrong shape": (entry("x", np.zeros(3)), f"'x' is an array of float64 .3,., .* be {ARRAY}"),
    "scalar": (entry("x", 1.0), rf"'x' is 1.0 \(float\), and should be {ARRAY}"),
    "text": (entry("x", "left"), rf"'x' is 'left' \(str\), and should be {ARRAY}"),
    "text in it": (entry("x", np.array(["a", "b"])), f"'x' is an array of <U1 .*should be {ARRAY}"),
    "none in it": (entry("x", [None, 1.0]), rf"'x' is \[None, 1.0\] .*should be {ARRAY}"),
    "ragged": (entry("x", [[1.0], [1.0, 2.0]]), f"'x' is .*should be {ARRAY}"),
    "complex": (entry("x", np.zeros(2, complex)), f"an array of complex128 .*be {ARRAY}"),
    "nan": (entry("x", np.array([0.0, np.nan])), "observation 'x' of .* is nan, and should be fin"),
    "inf": (entry("x", np.array([-np.inf, 0])), "observation 'x' of .* is -inf, and should be fin"),
    "out of range": (entry("kind", 7), r"'kind' is 7 \(int\), and should be of Discrete\(3\)"),
    "fraction": (entry("kind", 0.5), r"'kind' is 0.5 \(float\), and should be of Discrete"),
    "no info": (lambda good: (*good[:-1], None), "dictionary"),
    "info list": (lambda good: (*good[:-1], []), "dictionary"),
}
"""In resets and steps: what is returned, and what the message says."""
IN_STEPS: dict[str, tuple[Any, str]] = {
    "reward text": (result(1, "much"), r"the reward is 'much' \(str\), and should be a number"),
    "reward none": (result(1, None), r"the reward is None \(NoneType\), and should be a number"),
    "reward array": (
        result(1, np.ones(1)),
        r"the reward is an array of float64 \(1,\), .*a number",
    ),
    "reward complex": (result(1, 1j), "the reward is 1j .*a number"),
    "reward nan": (result(1, np.nan), "the reward of .* is nan, and should be finite"),
    "reward inf": (result(1, np.inf), "the reward of .* is inf, and should be finite"),
    "terminated text": (result(2, "False"), "`terminated` is 'False' .* be True or False"),
    "terminated none": (result(2, None), "`terminated` is None .* be True or False"),
    "terminated array": (result(2, np.zeros(2, bool)), "`terminated` is an array .*True or False"),
    "truncated number": (result(3, 2), "`truncated` is 2 .* be True or False"),
}
OF_PROCESSES: dict[str, tuple[Any, str]] = {
    "leaves": (lambda good: os._exit(5), r"process \d+ exited with 5 when it was asked to "),
    "killed": (
        lambda good: os.kill(os.getpid(), signal.SIGKILL),
        r"\d+ was killed by SIGKILL when",
    ),
    "hangs": (hang, r"\(process \d+\) was asked to \w+, and has not answered for 3 s: it hangs"),
}
FAULTS = ANYWHERE | IN_STEPS | OF_PROCESSES
CASES = [
    (name, step, vectorization)
    for vectorization in ("sync", "async")
    for step in (RESET, FIRST, LATER)
    for name in FAULTS
    if (name not in IN_STEPS or step != RESET)
    and (name not in OF_PROCESSES or vectorization == "async")
]
SAMPLE = {
    ("runtime error", LATER, "async"),
    ("unpicklable", FIRST, "async"),
    ("exit", LATER, "sync"),
    ("too few", LATER, "sync"),
    ("missing key", LATER, "sync"),
    ("wrong shape", LATER, "async"),
    ("text", RESET, "sync"),
    ("nan", FIRST, "sync"),
    ("reward array", LATER, "sync"),
    ("terminated text", LATER, "sync"),
    ("killed", RESET, "async"),
    ("leaves", LATER, "async"),
}


class Faulty(gymnasium.Env[Any, Any]):
    """Two numbers and a kind, without an end; one of the run's environments has a fault.

    Args:
        fault: its name.
        step: in which it is.
    """

    observation_space = Dict({"x": Box(-1.0, 1.0, (2,), np.float32), "kind": Discrete(3)})
    action_space = Discrete(2)

    def __init__(self, fault: str, step: int):
        self.fault = FAULTS[fault][0] if fault in FAULTS else hang_while_stopping
        self.step_of_fault = step

    def reset(self, *, seed: int | None = None, options: Any = None) -> Returned:
        super().reset(seed=seed)
        self.steps = 0
        self.is_faulty = seed == episode_seed(0, FAULTY, 0)
        return self._returned(self._observation(), {})

    def step(self, action: Any) -> Returned:
        self.steps += 1
        return self._returned(self._observation(), 0.0, False, False, {})

    def _observation(self) -> dict[str, Any]:
        return {"x": np.zeros(2, np.float32), "kind": 0}

    def _returned(self, *good: Any) -> Returned:
        returned: Returned = good
        if self.is_faulty and self.steps == self.step_of_fault:
            returned = self.fault(good)
        return returned


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register(ENV_ID, entry_point=Faulty)
    yield
    del gymnasium.registry[ENV_ID]


def environment(fault: str, step: int, vectorization: str) -> dict[str, Any]:
    return {
        "type": "gymnasium",
        "id": ENV_ID,
        "num_envs": NUM_ENVS,
        "vectorization": vectorization,
        "timeout_s": 3.0 if fault == "hangs" else 60.0,
        "max_lifetime_restarts": 0,
        "kwargs": {"fault": fault, "step": step},
    }


def assert_saved(results: Path, step: int, state: str, reason: str) -> None:
    """As of the last update before a step of each environment; nothing, where no run began."""
    saved = sorted(results.glob("*/checkpoints/step-*"))
    if step == RESET:
        assert not results.exists() or not saved
        return
    status = json.loads((results / "toy/status.json").read_text())
    assert status["state"] == state
    assert re.search(reason, status["reason"])
    collections = (step - 1) * NUM_ENVS // BUFFER_STEPS
    assert int(saved[-1].name.removeprefix("step-")) == collections * BUFFER_STEPS


@pytest.mark.filterwarnings("ignore::UserWarning:gymnasium.utils")
@pytest.mark.parametrize(
    ("fault", "step", "vectorization"),
    [pytest.param(*c, marks=[] if c in SAMPLE else [pytest.mark.soak]) for c in CASES],
)
def test_a_fault_is_named_and_the_run_is_saved(
    learn: Learn, write_run: WriteRun, fault: str, step: int, vectorization: str
) -> None:
    trainer = {"max_steps": 200, "hyperparameters": {"buffer_size": BUFFER_STEPS}}
    done = learn(write_run(environment(fault, step, vectorization), trainer))
    when = f"step {step * NUM_ENVS}: .*"
    # Numbers are looked at by whoever counts the steps, who has counted none at a reset.
    named = rf"^error: {when if step else f'({when})?'}environment {FAULTY} of '{ENV_ID}'"
    assert re.search(named, done.errors, re.MULTILINE), done.errors
    assert re.search(FAULTS[fault][1], done.errors), done.errors
    assert done.code == 1
    assert "Traceback" not in done.errors + done.output
    assert_saved(done.results, step, "failed", f"environment {FAULTY} of")


@pytest.mark.filterwarnings("ignore::UserWarning:gymnasium.utils")
@pytest.mark.parametrize(
    ("fault", "step"),
    [
        ("leaves", RESET),
        ("killed", LATER),
        *(
            pytest.param(fault, step, marks=pytest.mark.soak)
            for fault, step in [("leaves", LATER), ("killed", FIRST), ("hangs", LATER)]
        ),
    ],
)
def test_a_run_goes_on_with_a_process_that_was_started_again(
    learn: Learn, write_run: WriteRun, caplog: pytest.LogCaptureFixture, fault: str, step: int
) -> None:
    allowed = environment(fault, step, "async") | {"max_lifetime_restarts": 10}
    trainer = {"max_steps": 200, "hyperparameters": {"buffer_size": BUFFER_STEPS}}
    done = learn(write_run(allowed, trainer))
    if step == RESET:  # of the same episode, in which it dies again
        assert done.code == 1
        assert "it had been started again 1 times, and may not be once more" in done.errors
        return
    assert done.code == 0, done.errors
    assert done.step == 208
    [told] = caplog.messages
    assert re.search(FAULTS[fault][1], told)
    assert told.startswith(f"environment {FAULTY} of '{ENV_ID}'")
    assert told.endswith(": it is started again, and its episode is cut off")
    assert json.loads((done.results / "toy/status.json").read_text())["state"] == "finished"
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("vectorization", ["sync", "async"])
@pytest.mark.parametrize(
    ("step", "patience_s"),
    [
        (LATER, 0.1),
        pytest.param(RESET, 0.1, marks=pytest.mark.soak),
        pytest.param(LATER, stopping.PATIENCE_S, marks=pytest.mark.soak),
    ],
)
def test_sigterm_ends_a_run_whose_environment_hangs(
    learn: Learn,
    write_run: WriteRun,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    step: int,
    patience_s: float,
    vectorization: str,
) -> None:
    hung = tmp_path / "hung"
    monkeypatch.setenv(HUNG, str(hung))
    monkeypatch.setattr(stopping, "PATIENCE_S", patience_s)
    if patience_s < 1.0:
        monkeypatch.setattr(processes, "CLOSE_TIMEOUT_S", 0.5)
    trainer = {"max_steps": 200, "hyperparameters": {"buffer_size": BUFFER_STEPS}}
    done = learn(write_run(environment("hangs, stopped", step, vectorization), trainer))
    assert time.time() - hung.stat().st_mtime < 10.0
    assert done.code == 143
    assert "Traceback" not in done.errors
    assert_saved(done.results, step, "interrupted", "stopped, and saved")
    assert not multiprocessing.active_children()
