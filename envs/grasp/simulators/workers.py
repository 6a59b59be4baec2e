"""A simulator spread over worker processes, each with an equal share of the worlds."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection, Pipe
from typing import Any

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import DepthImage
from envs.grasp.robot.paths import Path
from envs.grasp.robot.urdf import Robot
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.settings import Support
from envs.grasp.simulators.base import Contacts, Floats, Images, Indices, SimulatorError
from envs.grasp.simulators.pybullet import PyBulletSimulator
from envs.processes import end_with_parent

ANSWER_TIMEOUT_S = 300.0
"""For what one call asks of one worker's worlds, which takes a second or so."""
CLOSE_TIMEOUT_S = 5.0
"""For all workers to end; those that have not are killed."""


class ParallelSimulator:
    """N worlds over worker processes. Implements `envs.grasp.simulators.base.Simulator`.

    A worker is a plain subprocess running this module, so that it imports the simulator and not the
    learner; it ends with its parent, however that came to its end, and whatever it was doing.

    Args:
        num_worlds: N.
        num_workers: processes, at most N.
        robot: stands in every world.
        support: the table.
    """

    def __init__(self, num_worlds: int, num_workers: int, robot: Robot, support: Support):
        shares = np.array_split(np.arange(num_worlds), num_workers)
        self._starts = np.array([share[0] for share in shares])
        self._workers = [_Worker(number) for number in range(num_workers)]
        for worker, share in zip(self._workers, shares, strict=True):
            worker.send((len(share), robot, support))

    def load(self, indices: Indices, scenes: Scenes, joints_rad: Floats) -> None:
        """See `Simulator.load`."""
        self._call("load", indices, scenes, joints_rad)

    def move(self, indices: Indices, path_rad: Path, resolution_m: float) -> Contacts:
        """See `Simulator.move`."""
        parts: list[Contacts] = self._call("move", indices, path_rad, resolution_m)
        return Contacts(
            np.concatenate([part.touched for part in parts]),
            np.concatenate([part.collided for part in parts]),
        )

    def render(self, indices: Indices, views: CameraPoses) -> Images:
        """See `Simulator.render`."""
        return np.concatenate(self._call("render", indices, views))

    def render_depth(
        self, indices: Indices, views: CameraPoses, space: DepthImage, seeds: NDArray[np.uint64]
    ) -> Images:
        """See `Simulator.render_depth`."""
        return np.concatenate(self._call("render_depth", indices, views, space, seeds))

    def close(self) -> None:
        """See `Simulator.close`."""
        workers, self._workers = self._workers, []
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        for worker in workers:
            worker.dismiss()
        for worker in workers:
            worker.end(deadline)

    def _call(self, method: str, indices: Indices, *arguments: Any) -> list[Any]:
        """Calls a method with each worker's rows of the arguments; what has no rows goes to all."""
        owners = np.searchsorted(self._starts, indices, side="right") - 1
        busy = []
        for number in np.unique(owners):
            rows = np.flatnonzero(owners == number)
            part = [a if isinstance(a, DepthImage | float) else a[rows] for a in arguments]
            self._workers[number].send((method, indices[rows] - self._starts[number], *part))
            busy.append(self._workers[number])
        replies, failures = [], []
        for worker in busy:  # all of them, or an answer left behind would be taken for the next one
            try:
                replies.append(worker.receive())
            except SimulatorError as error:
                failures.append(error)
        if failures:
            raise failures[0]
        return replies


class _Worker:
    """The parent's end of one worker process."""

    def __init__(self, number: int):
        self._number = number
        self._pipe, childs_end = Pipe()
        # A session of its own: Ctrl-C in the terminal is for the learner, which stops the workers.
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(childs_end.fileno())],
            pass_fds=[childs_end.fileno()],
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        childs_end.close()

    def send(self, message: tuple[Any, ...]) -> None:
        try:
            self._pipe.send(message)
        except (BrokenPipeError, ConnectionResetError) as error:
            raise self._death() from error

    def receive(self) -> Any:
        if not self._pipe.poll(ANSWER_TIMEOUT_S):
            raise SimulatorError(
                f"worker {self._number} (process {self._process.pid}) of the simulator has not "
                f"answered for {ANSWER_TIMEOUT_S:g} s: it hangs"
            )
        try:
            succeeded, value = self._pipe.recv()
        except (EOFError, ConnectionResetError) as error:
            raise self._death() from error
        if not succeeded:
            raise SimulatorError(f"worker {self._number} failed: {value}")
        return value

    def dismiss(self) -> None:
        self._pipe.close()

    def end(self, deadline: float) -> None:
        try:
            self._process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _death(self) -> SimulatorError:
        try:
            code = self._process.wait(CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return SimulatorError(f"worker {self._number} closed its pipe and hangs")
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with {code}"
        return SimulatorError(
            f"worker {self._number} (process {self._process.pid}) of the simulator {how}"
        )


def _serve(pipe: Connection) -> None:
    """A worker's life: build the simulator, then do what is asked until the pipe closes."""
    end_with_parent()
    simulator: PyBulletSimulator | None = None
    try:
        simulator = PyBulletSimulator(*pipe.recv())
        while True:
            method, *arguments = pipe.recv()
            try:
                reply = True, getattr(simulator, method)(*arguments)
            except Exception as error:  # the parent is told, and decides
                reply = False, f"{type(error).__name__}: {error}"
            pipe.send(reply)
    except (EOFError, ConnectionResetError, BrokenPipeError):
        pass
    finally:
        if simulator is not None:
            simulator.close()


if __name__ == "__main__":
    _serve(Connection(int(sys.argv[1])))
