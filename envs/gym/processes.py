"""Environments in processes of their own, which are waited for no longer than it makes sense."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import select
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import (
    batch_space,
    create_shared_memory,
    iterate,
    read_from_shared_memory,
    write_to_shared_memory,
)
from numpy.typing import NDArray

from envs.environment import EnvironmentFailure
from envs.processes import end_with_parent

CLOSE_TIMEOUT_S = 5.0
"""For all of them to close; those that have not are killed."""
CUT_OFF: tuple[Any, ...] = (0.0, False, True, {})
"""Reward, terminated, truncated and info of a step whose process was lost: nobody knows better."""

Maker = Callable[[], gymnasium.Env[Any, Any]]
Answer = tuple[bool, Any]
"""Whether it went well, and the result; or the error."""
Message = tuple[str, tuple[Any, ...]]
"""A method's name and its arguments."""

_logger = logging.getLogger("ventosa")


class ProcessLost(EnvironmentFailure):
    """The process of an environment died or hangs; the message says which and how."""


@dataclass(frozen=True)
class RestartLimits:
    """How often a lost process is started again, each for itself; -1: as often as it takes.

    Attributes:
        lifetime: times in all.
        in_period: times within the period.
        period_s: of time.
    """

    lifetime: int = 0
    in_period: int = -1
    period_s: float = 60.0

    def allow(self, restarts: Sequence[float], now: float) -> bool:
        """Whether there may be another one, after those that were at some times, in seconds."""
        recent = sum(now - at <= self.period_s for at in restarts)
        return not (0 <= self.lifetime <= len(restarts) or 0 <= self.in_period <= recent)


class ProcessVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """N environments, each in a process of its own, reset in the step an episode ends in.

    It is used as gymnasium's `AsyncVectorEnv` is, but says which process did not answer or died,
    leaves none behind however it ends itself, and fails without a traceback. Observations are
    handed out without a copy, and hold until the next step.

    A process that is lost in a step or a reset is started again, within limits. The episode it was
    in is truncated, without a last observation in the infos: it is the one before the step.

    Args:
        makers: of the environments.
        name: of the environments, for messages.
        timeout_s: to wait for an answer.
        limits: of starting lost ones again.
        prepare: what an environment is asked when it was started again, before it is reset.

    Raises:
        RuntimeError: the spaces of the environments differ.
        EnvironmentFailure: one of the processes died or hangs.
    """

    def __init__(
        self,
        makers: Sequence[Maker],
        name: str,
        timeout_s: float,
        limits: RestartLimits = RestartLimits(),
        prepare: Callable[[], Sequence[Message]] = tuple,
    ):
        self.num_envs, self._workers = len(makers), list[_Worker]()
        self._prepare = prepare
        first = makers[0]()
        self.metadata = {**first.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        spaces = first.observation_space, first.action_space
        first.close()
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (batch_space(s, len(makers)) for s in spaces)
        shared = create_shared_memory(spaces[0], len(makers))
        self._observations = read_from_shared_memory(spaces[0], shared, len(makers))
        try:
            for index, maker in enumerate(makers):
                called = f"environment {index} of {name!r}"
                self._workers.append(_Worker(index, called, maker, shared, timeout_s, limits))
            made = self._answers("be made")
        except BaseException:
            self.close()
            raise
        if any(own != spaces for own in made):
            self.close()
            raise RuntimeError(f"their spaces differ: {made}")

    @property
    def processes(self) -> list[multiprocessing.Process]:
        """One of each environment."""
        return [worker.process for worker in self._workers]

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode everywhere, whose seeds the environments know themselves.

        Raises:
            EnvironmentFailure: an environment failed, or its process was lost once too often.
        """
        self._ask("reset", [()] * self.num_envs, if_lost=())
        return self._observations, {}

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Steps every environment; errors as `reset`'s."""
        arguments = [(action,) for action in iterate(self.action_space, actions)]
        answers = self._ask("step", arguments, if_lost=CUT_OFF)
        infos: dict[str, Any] = {}
        for index, (*_, info) in enumerate(answers):
            infos = self._add_info(infos, info, index)
        reward, terminated, truncated, _ = zip(*answers, strict=True)
        return (
            self._observations,
            np.array(reward, np.float64),
            np.array(terminated, np.bool_),
            np.array(truncated, np.bool_),
            infos,
        )

    def call(self, name: str, *arguments: Any) -> list[Any]:
        """Results of a method of every environment.

        To play episodes again may take the time-out for each of their steps.

        Raises:
            EnvironmentFailure: an environment failed, or its process was lost.
        """
        steps = len(arguments[-1]) if name == "play" else 1
        return self._ask(name, [arguments] * self.num_envs, max(steps, 1))

    def close_extras(self, **kwargs: Any) -> None:
        """Lets all environments close, and kills those that don't."""
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        for worker in self._workers:
            worker.dismiss()
        for worker in self._workers:
            worker.end(deadline)

    def _ask(
        self,
        method: str,
        arguments: Iterable[tuple[Any, ...]],
        steps: int = 1,
        if_lost: tuple[Any, ...] | None = None,
    ) -> list[Any]:
        for worker, given in zip(self._workers, arguments, strict=True):
            worker.send((method, given))
        return self._answers(method, steps, if_lost)

    def _answers(
        self, asked: str, steps: int = 1, if_lost: tuple[Any, ...] | None = None
    ) -> list[Any]:
        """Answers of all; in the place of a lost one's what is given, and its next episode begins.

        Raises:
            EnvironmentFailure: nothing is given, or a process was lost once too often.
        """
        begin, answers = time.monotonic(), []
        for worker in self._workers:
            try:
                answers.append(worker.receive(asked, begin, steps))
            except ProcessLost as lost:
                if if_lost is None:
                    raise
                self._start_again(worker, lost)
                answers.append(if_lost)
        return answers

    def _start_again(self, worker: _Worker, lost: ProcessLost) -> None:
        """Starts a lost process again, as often as it takes and may, and begins an episode there.

        Raises:
            ProcessLost: it was lost once too often.
        """
        while True:
            worker.start_again(lost)
            try:
                worker.receive("be made", time.monotonic())
                for method, arguments in [*self._prepare(), ("reset", ())]:
                    worker.send((method, arguments))
                    worker.receive(method, time.monotonic())
                return
            except ProcessLost as again:
                lost = again


class _Worker:
    """The learner's end of one environment's process."""

    def __init__(
        self,
        index: int,
        called: str,
        maker: Maker,
        shared: Any,
        timeout_s: float,
        limits: RestartLimits,
    ):
        self._index, self._called, self._maker, self._shared = index, called, maker, shared
        self._timeout_s, self._limits = timeout_s, limits
        self._restarts: list[float] = []  # when they were, by `time.monotonic`
        self._start()

    def _start(self) -> None:
        self._pipe, childs_end = multiprocessing.Pipe()
        arguments = (self._index, self._called, self._maker, childs_end, self._shared)
        self.process = multiprocessing.Process(target=_serve, args=arguments, daemon=True)
        self.process.start()
        childs_end.close()
        self._answers = select.poll()
        self._answers.register(self._pipe, select.POLLIN)

    def start_again(self, lost: ProcessLost) -> None:
        """Begins anew, after what is left was killed.

        Raises:
            ProcessLost: it may not be started once more.
        """
        now, count = time.monotonic(), len(self._restarts)
        if not self._limits.allow(self._restarts, now):
            if not count:
                raise lost
            raise ProcessLost(
                f"{lost}; it had been started again {count} times, and may not be once more: see "
                "environment.max_lifetime_restarts and restarts_rate_limit_n"
            )
        _logger.warning("%s: it is started again, and its episode is cut off", lost)
        self._restarts.append(now)
        self._pipe.close()
        self.end(now)
        self._start()

    def send(self, message: Message) -> None:
        with contextlib.suppress(ConnectionError):  # it died, and `receive` says how
            self._pipe.send(message)

    def receive(self, asked: str, begin: float, steps: int = 1) -> Any:
        """Its answer.

        Args:
            asked: what it was asked to do.
            begin: when, by `time.monotonic`.
            steps: that it may take as long as.

        Raises:
            ProcessLost: the process died or did not answer.
            Exception: the environment's own.
        """
        timeout_s = self._timeout_s * steps
        left_s = max(begin + timeout_s - time.monotonic(), 0.0)
        if not self._answers.poll(1000.0 * left_s):
            raise ProcessLost(
                f"{self._called} (process {self.process.pid}) was asked to {asked}, and has not "
                f"answered for {timeout_s:g} s: it hangs, or needs a higher environment.timeout_s"
            )
        try:
            went_well, result = self._pipe.recv()
        except (EOFError, ConnectionError):
            raise self._death(asked) from None
        if not went_well:
            raise result
        return result

    def dismiss(self) -> None:
        with contextlib.suppress(OSError):
            self._pipe.send(None)
        self._pipe.close()

    def end(self, deadline: float) -> None:
        self.process.join(max(deadline - time.monotonic(), 0.0))
        self.process.kill()
        self.process.join()

    def _death(self, asked: str) -> ProcessLost:
        self.process.join(CLOSE_TIMEOUT_S)
        code = self.process.exitcode
        how = f"exited with {code}"
        if code is not None and code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
        return ProcessLost(
            f"{self._called}: its process {self.process.pid} {how} when it was asked to {asked}"
        )


def _serve(index: int, called: str, maker: Maker, pipe: Connection, shared: Any) -> None:
    """An environment's life: does what it is asked until it is dismissed."""
    end_with_parent()
    learner = multiprocessing.parent_process()
    if learner is None or os.getppid() != learner.pid:
        return  # it ended before this could end with it
    # Ctrl-C is for the learner, which ends its environments.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    try:
        env = maker()
    except Exception as error:
        pipe.send((False, error))
        return
    pipe.send((True, (env.observation_space, env.action_space)))
    with contextlib.suppress(EOFError, ConnectionError):
        while (message := pipe.recv()) is not None:
            _answer(env, index, called, pipe, shared, *message)
    with contextlib.suppress(Exception):  # nobody is left to be told
        env.close()


def _answer(
    env: gymnasium.Env[Any, Any],
    index: int,
    called: str,
    pipe: Connection,
    shared: Any,
    method: str,
    arguments: tuple[Any, ...],
) -> None:
    try:
        result = getattr(env, method)(*arguments)
        if method == "step":
            result = _reset_at_its_end(env, *result)
        if method in ("reset", "step"):
            observation, *result = result
            write_to_shared_memory(env.observation_space, index, observation, shared)
        pipe.send((True, result))
    except EnvironmentFailure as failure:
        pipe.send((False, failure))
    except Exception as error:  # what a process can't hand over, such as a lambda in an info
        said = f"`{method}` can't be answered: {type(error).__name__}: {error}"
        pipe.send((False, EnvironmentFailure(f"{called}: {said}")))


def _reset_at_its_end(
    env: gymnasium.Env[Any, Any],
    observation: Any,
    reward: Any,
    terminated: bool,
    truncated: bool,
    info: dict[str, Any],
) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
    """What came of a step; where it ended an episode, the next has begun."""
    if terminated or truncated:
        last = {"final_obs": observation, "final_info": info}
        observation, begins = env.reset()
        info = {**last, **begins}
    return observation, reward, terminated, truncated, info
