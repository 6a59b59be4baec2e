"""Chooses the engine a run file asks for."""

from __future__ import annotations

from envs.grasp.robot.urdf import Robot
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.base import Simulator
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.installation import require_pybullet
from trainers.common.cores import usable_cores

# Fewer worlds a process than this, and the messages cost more than the second core gives.
MIN_WORLDS_PER_WORKER = 4


def make_simulator(
    settings: GraspSettings, robot: Robot, num_worlds: int, window: bool = False
) -> Simulator:
    """Builds the simulator of a run; a window means no worker processes.

    Raises:
        ValueError: a window is asked for where there is none, or PyBullet is not installed.
    """
    if settings.simulator == "fast":
        return _fast(settings, robot, num_worlds, window)
    return _pybullet(settings, robot, num_worlds, window)


def _pybullet(settings: GraspSettings, robot: Robot, num_worlds: int, window: bool) -> Simulator:
    require_pybullet("simulator: pybullet")
    # Imported late, as they import PyBullet.
    from envs.grasp.simulators.pybullet import PyBulletSimulator  # noqa: PLC0415
    from envs.grasp.simulators.workers import ParallelSimulator  # noqa: PLC0415

    workers = settings.workers
    if workers is None:
        workers = min(usable_cores(), num_worlds // MIN_WORLDS_PER_WORKER)
        workers = workers if workers > 1 else 0
    if window or workers == 0:
        return PyBulletSimulator(num_worlds, robot, settings.support, window)
    return ParallelSimulator(num_worlds, min(workers, num_worlds), robot, settings.support)


def _fast(settings: GraspSettings, robot: Robot, num_worlds: int, window: bool) -> FastSimulator:
    if window:
        raise ValueError(
            "simulator: fast has no window: use simulator: pybullet, or render_mode: rgb_array"
        )
    return FastSimulator(num_worlds, robot, settings.support, settings.threads)
