"""Environments in processes of their own: that hang, die, and are left by their learner."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from envs.environment import EnvironmentFailure
from envs.gym import processes
from envs.gym.processes import ProcessVectorEnv


class Clock(gymnasium.Env[Any, Any]):
    """Sees its steps; its episodes have three.

    Args:
        size: of its observations.
        info: of its steps.
    """

    action_space = Discrete(2)

    def __init__(self, size: int = 1, info: Any = None):
        self.observation_space = Box(0.0, 9.0, (size,), np.float32)
        self.info = {} if info is None else {"info": info}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.steps = 0
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        seen = np.full(self.observation_space.shape, self.steps, np.float32)
        return seen, float(action), False, self.steps == 3, self.info

    def play(self, *arguments: Any) -> str:
        return "played"


ACTIONS = np.array([0, 1])


def make(*makers: Callable[[], Any], timeout_s: float = 60.0) -> ProcessVectorEnv:
    return ProcessVectorEnv(makers or (Clock, Clock), "Clock", timeout_s)


def ended(pids: list[int], within_s: float) -> bool:
    """Whether processes end in time; one that its parent has not asked for is none any more."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        if not any(alive(pid) for pid in pids):
            return True
        time.sleep(0.02)
    return False


def alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_it_steps_and_resets_as_gymnasium_does() -> None:
    with closing(make()) as env:
        assert env.reset()[0].tolist() == [[0.0], [0.0]]
        for step in (1, 2):
            observations, reward, terminated, truncated, infos = env.step(ACTIONS)
            assert observations.tolist() == [[step], [step]]
            assert (reward.dtype, reward.tolist()) == (np.float64, [0.0, 1.0])
            assert not terminated.any()
            assert not truncated.any()
            assert infos == {}
        observations, *_, truncated, infos = env.step(ACTIONS)
        assert observations.tolist() == [[0.0], [0.0]]
        assert truncated.tolist() == [True, True]
        assert [last.tolist() for last in infos["final_obs"]] == [[3.0], [3.0]]
        assert env.call("play", ACTIONS) == ["played", "played"]


def test_one_that_does_not_answer_is_named_and_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "CLOSE_TIMEOUT_S", 0.2)
    env = make()
    env.reset()
    for worker in env._workers:
        worker._timeout_s = 0.3
    pids = [process.pid for process in env.processes]
    os.kill(pids[1], signal.SIGSTOP)
    told = (
        rf"^environment 1 of 'Clock' \(process {pids[1]}\) was asked to step, and has not "
        r"answered for 0.3 s: it hangs, or needs a higher environment.timeout_s$"
    )
    with pytest.raises(EnvironmentFailure, match=told):
        env.step(ACTIONS)
    # An episode of five steps may take five times as long.
    with pytest.raises(EnvironmentFailure, match=r"asked to play, and has not .* for 1.5 s"):
        env.call("play", np.zeros((5, 2)))
    env.close()
    assert ended(pids, 1.0)


def test_what_a_process_can_not_hand_over_is_a_failure() -> None:
    with closing(make(partial(Clock, info=lambda: None))) as env:
        env.reset()
        with pytest.raises(
            EnvironmentFailure, match=r"environment 0 of 'Clock': `step` can.*pickle"
        ):
            env.step(ACTIONS[:1])


def test_spaces_that_differ_are_refused() -> None:
    with pytest.raises(RuntimeError, match=r"spaces differ: .*\(1,\).*\(2,\)"):
        make(Clock, partial(Clock, 2))


@pytest.mark.parametrize("how", [signal.SIGSTOP, None])
def test_no_process_outlives_a_learner_that_is_killed(how: signal.Signals | None) -> None:
    """Not even one that hangs, here because it was stopped."""
    reading, writing = os.pipe()
    learner = os.fork()
    if learner == 0:
        try:
            env = make(Clock, Clock, Clock)
            env.reset()
            os.write(writing, " ".join(str(process.pid) for process in env.processes).encode())
            time.sleep(3600.0)
        finally:
            os._exit(1)
    pids = [int(word) for word in os.read(reading, 1000).split()]
    if how is not None:
        os.kill(pids[1], how)
    os.kill(learner, signal.SIGKILL)
    os.waitpid(learner, 0)
    assert ended(pids, 5.0)
