"""Environments in processes of their own: that hang, die, and are left by their learner."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from envs.environment import EnvironmentFailure
from envs.gym import processes
from envs.gym.processes import Message, ProcessLost, ProcessVectorEnv, RestartLimits


class Clock(gymnasium.Env[Any, Any]):
    """Sees its steps; its episodes have three.

    Args:
        size: of its observations.
        info: of its steps.
    """

    action_space = Discrete(2)

    def __init__(self, size: int = 1, info: Any = None):
        self.begins_at = 0
        self.observation_space = Box(0.0, 9.0, (size,), np.float32)
        self.info = {} if info is None else {"info": info}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.steps = self.begins_at
        return np.full(self.observation_space.shape, self.steps, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        seen = np.full(self.observation_space.shape, self.steps, np.float32)
        return seen, float(action), False, self.steps == 3, self.info

    def play(self, *arguments: Any) -> str:
        return "played"

    def begin_at(self, steps: int) -> None:
        self.begins_at = steps


ACTIONS = np.array([0, 1])


def make(*makers: Callable[[], Any], timeout_s: float = 60.0, **options: Any) -> ProcessVectorEnv:
    return ProcessVectorEnv(makers or (Clock, Clock), "Clock", timeout_s, **options)


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


def lose(env: ProcessVectorEnv, index: int) -> None:
    process = env.processes[index]
    process.kill()
    process.join()


def test_one_that_died_is_started_again_and_its_episode_cut_off(
    caplog: pytest.LogCaptureFixture,
) -> None:
    asked: list[Message] = [("begin_at", (1,))]
    with closing(make(limits=RestartLimits(lifetime=1), prepare=lambda: asked)) as env:
        env.reset()
        env.step(ACTIONS)
        lost = env.processes[1].pid
        lose(env, 1)
        observations, reward, terminated, truncated, infos = env.step(ACTIONS + 5)
        assert observations.tolist() == [[2.0], [1.0]]  # and the next one begins as it was told to
        assert reward.tolist() == [5.0, 0.0]
        assert terminated.tolist() == [False, False]
        assert truncated.tolist() == [False, True]
        assert infos == {}
        assert env.processes[1].pid != lost
        assert caplog.messages == [
            f"environment 1 of 'Clock': its process {lost} was killed by SIGKILL when it was asked "
            "to step: it is started again, and its episode is cut off"
        ]
        observations, _, _, truncated, infos = env.step(ACTIONS)
        assert observations.tolist() == [[0.0], [2.0]]
        assert truncated.tolist() == [True, False]
        assert infos["final_obs"][0].tolist() == [3.0]

        lose(env, 1)
        told = "had been started again 1 times, and may not be once more: see environment.max_life"
        with pytest.raises(ProcessLost, match=told):
            env.step(ACTIONS)


def test_one_that_hangs_is_killed_and_started_again() -> None:
    with closing(make(timeout_s=2.0, limits=RestartLimits(lifetime=1))) as env:
        env.reset()
        pid = env.processes[0].pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        observations, *_, truncated, _ = env.step(ACTIONS)
        assert truncated.tolist() == [True, False]
        assert observations.tolist() == [[0.0], [1.0]]
        assert ended([pid], 1.0)


def test_one_that_dies_in_a_reset_begins_again() -> None:
    with closing(make(limits=RestartLimits(lifetime=-1))) as env:
        lose(env, 0)
        assert env.reset()[0].tolist() == [[0.0], [0.0]]
        lose(env, 0)
        # What has to be known of every environment, nobody else can answer.
        with pytest.raises(ProcessLost, match="asked to play"):
            env.call("play", ACTIONS)


def test_one_that_is_lost_again_while_it_begins_has_another_try(tmp_path: Path) -> None:
    """Its maker kills the process the second time that it makes an environment."""

    def maker() -> Clock:
        made = len(list(tmp_path.iterdir()))
        (tmp_path / str(made)).touch()
        if made == 2:  # the first was to see the spaces
            os._exit(7)
        return Clock()

    with closing(make(maker, limits=RestartLimits(lifetime=2))) as env:
        env.reset()
        lose(env, 0)
        assert env.step(ACTIONS[:1])[3].tolist() == [True]
        assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize(
    ("limits", "restarts", "allowed"),
    [
        (RestartLimits(lifetime=0), [], False),
        (RestartLimits(lifetime=2), [1.0], True),
        (RestartLimits(lifetime=2), [1.0, 2.0], False),
        (RestartLimits(lifetime=-1), [1.0] * 99, True),
        (RestartLimits(lifetime=9, in_period=1, period_s=60.0), [40.0], False),
        (RestartLimits(lifetime=9, in_period=1, period_s=60.0), [39.0], True),
        (RestartLimits(lifetime=9, in_period=2, period_s=60.0), [39.0, 40.0], True),
        (RestartLimits(lifetime=9, in_period=0, period_s=60.0), [], False),
        (RestartLimits(lifetime=2, in_period=-1), [99.0, 99.0], False),
    ],
)
def test_restarts_are_limited_in_all_and_within_a_time(
    limits: RestartLimits, restarts: list[float], allowed: bool
) -> None:
    assert limits.allow(restarts, now=100.0) is allowed


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
