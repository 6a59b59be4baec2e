from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from encoders.spaces import DepthImage
from envs.environment import EnvironmentFailure
from envs.grasp.robot.kinematics import InverseKinematics
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import Scenes, SceneSampler
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.settings import Camera, GraspSettings, Support
from envs.grasp.simulators.base import SimulatorError
from envs.grasp.simulators.pybullet import PyBulletSimulator
from envs.grasp.simulators.workers import ParallelSimulator

ROOT = Path(__file__).parents[4]
ROBOT = load_robot()
RESOLUTION_M = 0.005
COUNT = 7  # not a multiple of the workers
CAMERAS = {
    "depth": Camera(type="depth", width=48, height=40),
    "lit": Camera(
        type="depth",
        width=48,
        height=40,
        sensor={"type": "structured_light", "strength": (0.5, 3.0)},
    ),
    "rgb": Camera(type="rgb", width=40, height=48),
}
SPACE = DepthImage(40, 48)


def home(count: int) -> np.ndarray:
    return np.tile(ROBOT.home_rad, (count, 1))


@pytest.fixture(scope="module")
def scenes_and_views() -> tuple[Scenes, dict[str, CameraPoses]]:
    settings = GraspSettings(cameras=CAMERAS)
    return SceneSampler(settings).sample(np.random.default_rng(0), np.full(COUNT, np.pi))


@pytest.fixture(scope="module")
def paths(scenes_and_views: tuple[Scenes, dict[str, CameraPoses]]) -> np.ndarray:
    scenes, _ = scenes_and_views
    near = scenes.target_m + np.random.default_rng(1).uniform(-0.05, 0.05, (COUNT, 3))
    joints, _ = InverseKinematics(ROBOT)(near, scenes.target_yaw_rad)
    part = np.linspace(0.2, 1.0, 5)[None, :, None]
    return home(1)[None] * (1 - part) + joints[:, None] * part


@pytest.fixture(scope="module")
def in_process(
    scenes_and_views: tuple[Scenes, dict[str, CameraPoses]],
) -> Iterator[PyBulletSimulator]:
    simulator = PyBulletSimulator(COUNT, ROBOT, Support())
    yield simulator
    simulator.close()


@pytest.fixture
def two_workers() -> Iterator[ParallelSimulator]:
    simulator = ParallelSimulator(COUNT, 2, ROBOT, Support())
    yield simulator
    simulator.close()


def pids(simulator: ParallelSimulator) -> list[int]:
    return [worker._process.pid for worker in simulator._workers]


def runs(pid: int) -> bool:
    """Whether a process exists and is more than a zombie."""
    try:
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf8").rpartition(")")[2].split()[0]
    except (ProcessLookupError, FileNotFoundError):
        return False
    return state != "Z"


def test_results_are_those_of_one_process(
    two_workers: ParallelSimulator,
    in_process: PyBulletSimulator,
    scenes_and_views: tuple[Scenes, dict[str, CameraPoses]],
    paths: np.ndarray,
) -> None:
    scenes, views = scenes_and_views
    seeds = np.arange(COUNT).astype(np.uint64)
    # All worlds; then those of one worker alone, and some of both.
    for index in (np.arange(COUNT), np.array([4, 6]), np.array([0, 3, 5]), np.array([2])):
        results = []
        for simulator in (in_process, two_workers):
            simulator.load(index, scenes[index], home(len(index)))
            images = [simulator.render(index, view[index]) for view in views.values()]
            for view in (views["depth"][index], views["lit"][index]):
                images.append(simulator.render_depth(index, view, SPACE, seeds[index]))
            contacts = simulator.move(index, paths[index], RESOLUTION_M)
            images.append(simulator.render(index, views["rgb"][index]))  # the robot moved
            results.append([contacts.touched, contacts.collided, *images])
        for expected, seen in zip(*results, strict=True):
            assert seen.dtype == expected.dtype
            np.testing.assert_array_equal(seen, expected)
        if len(index) == COUNT:
            assert 0 < results[0][0].sum() < COUNT
            assert len(np.unique(results[0][2], axis=0)) == COUNT


def test_a_killed_worker_is_named_with_its_signal(
    two_workers: ParallelSimulator,
    scenes_and_views: tuple[Scenes, dict[str, CameraPoses]],
) -> None:
    scenes, views = scenes_and_views
    everywhere = np.arange(COUNT)
    two_workers.load(everywhere, scenes, home(COUNT))
    victim = pids(two_workers)[1]
    os.kill(victim, signal.SIGKILL)
    with pytest.raises(SimulatorError, match=rf"worker 1 \(process {victim}\).*SIGKILL") as caught:
        two_workers.render(everywhere, views["depth"])
    assert isinstance(caught.value, EnvironmentFailure)


def test_a_worker_that_dies_at_work_is_noticed(
    two_workers: ParallelSimulator,
    scenes_and_views: tuple[Scenes, dict[str, CameraPoses]],
) -> None:
    two_workers.load(np.arange(COUNT), scenes_and_views[0], home(COUNT))
    victim = pids(two_workers)[0]
    os.kill(victim, signal.SIGSTOP)  # it takes the message, and never answers
    two_workers._workers[0].send(("render", np.array([0]), scenes_and_views[1]["depth"][:1]))
    os.kill(victim, signal.SIGTERM)
    os.kill(victim, signal.SIGCONT)
    with pytest.raises(SimulatorError, match=r"worker 0 .*SIGTERM"):
        two_workers._workers[0].receive()


def test_a_worker_that_hangs_is_named_and_killed(
    scenes_and_views: tuple[Scenes, dict[str, CameraPoses]], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator = ParallelSimulator(COUNT, 2, ROBOT, Support())
    simulator.load(np.arange(COUNT), scenes_and_views[0], home(COUNT))
    victim = pids(simulator)[1]
    os.kill(victim, signal.SIGSTOP)
    monkeypatch.setattr("envs.grasp.simulators.workers.ANSWER_TIMEOUT_S", 0.1)
    told = rf"worker 1 \(process {victim}\) .* has not answered for 0.1 s: it hangs"
    with pytest.raises(SimulatorError, match=told):
        simulator._workers[1].receive()
    monkeypatch.setattr("envs.grasp.simulators.workers.CLOSE_TIMEOUT_S", 0.1)
    simulator.close()
    assert not runs(victim)


def test_a_workers_exception_is_passed_on_and_leaves_no_answer_behind(
    two_workers: ParallelSimulator,
    in_process: PyBulletSimulator,
    scenes_and_views: tuple[Scenes, dict[str, CameraPoses]],
    paths: np.ndarray,
) -> None:
    scenes, views = scenes_and_views
    late = np.arange(4, COUNT)  # the first worker's worlds are not loaded
    for simulator in (in_process, two_workers):
        simulator.load(late, scenes[late], home(len(late)))
    with pytest.raises(SimulatorError, match=r"worker 0 failed: KeyError"):
        two_workers.move(np.arange(COUNT), paths, RESOLUTION_M)
    # The second worker has moved its robots; its next answer is the one to the next question.
    in_process.move(late, paths[late], RESOLUTION_M)
    np.testing.assert_array_equal(
        two_workers.render(late, views["depth"][late]),
        in_process.render(late, views["depth"][late]),
    )


def test_workers_end_when_the_parent_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    # They have hardly started, which takes its time beside other work; none may have to be killed.
    monkeypatch.setattr("envs.grasp.simulators.workers.CLOSE_TIMEOUT_S", 60.0)
    simulator = ParallelSimulator(4, 2, ROBOT, Support())
    workers = [worker._process for worker in simulator._workers]
    assert len({worker.pid for worker in workers} | {os.getpid()}) == 3
    simulator.close()
    simulator.close()
    assert [worker.returncode for worker in workers] == [0, 0]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_workers_end_when_the_parent_is_killed() -> None:
    code = (
        "import os, signal\n"
        "from envs.grasp.robot.urdf import load_robot\n"
        "from envs.grasp.settings import Support\n"
        "from envs.grasp.simulators.workers import ParallelSimulator\n"
        "simulator = ParallelSimulator(4, 2, load_robot(), Support())\n"
        "for worker in simulator._workers:\n"
        "    worker.send(('__repr__',))\n"
        "    worker.receive()\n"
        "print(*[worker._process.pid for worker in simulator._workers], flush=True)\n"
        "input()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    workers = [int(pid) for pid in parent.stdout.readline().split()]
    assert len(workers) == 2
    assert all(runs(pid) for pid in workers)
    os.kill(workers[0], signal.SIGSTOP)  # one that hangs does, too
    parent.communicate("\n")
    assert parent.returncode == -signal.SIGKILL
    deadline = time.monotonic() + 30.0
    while any(runs(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(runs(pid) for pid in workers)
