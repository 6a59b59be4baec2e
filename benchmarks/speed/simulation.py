"""Pictures per second of the simulators, and steps per second of the environment on top of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np

from benchmarks.agreement import RESOLUTION_M, ROBOT, Sample
from benchmarks.speed.figures import FAST, MODES, PYBULLET, Figures, race, rate
from encoders.spaces import DepthImage
from envs.grasp.env import built_in_rewards, make_vector_env
from envs.grasp.observations import observation_space, picture_seeds
from envs.grasp.scene.sampler import SceneSampler
from envs.grasp.settings import Camera, GraspSettings
from envs.grasp.simulators.factory import make_simulator
from envs.grasp.vector_env import GraspVectorEnv

FRAMES = {"depth": "depth frames", "rgb": "color frames"}
"""Types of camera, and what is measured with them."""

STEPS = "environment steps"
EPISODE_STEPS = GraspSettings().episode_steps


def frames(kind: str, size: int, num_worlds: int, rounds: int, seconds: float) -> Figures:
    """Measures both simulators on all cores: the robot, the support and three blocks in view.

    Args:
        kind: one of `FRAMES`.
        size: side of the images in pixels.
        num_worlds: taken at once.
        rounds: of measurements in turn.
        seconds: of each measurement.
    """
    with ExitStack() as stack:
        measures = {}
        for name in (FAST, PYBULLET):
            camera = Camera.model_validate({"type": kind, "width": size, "height": size})
            worlds = Worlds(name, camera, num_worlds)
            stack.callback(worlds.simulator.close)
            rate(worlds.shoot, 0.0, worlds.change)  # compiles, and starts processes
            measures[name, num_worlds] = partial(
                _speed, FRAMES[kind], worlds.shoot, seconds, worlds.change
            )
        return race(measures, size, "", rounds)


def steps(mode: str, size: int, num_envs: Sequence[int], rounds: int, seconds: float) -> Figures:
    """Measures the grasp environment under random actions: all rewards, contacts, depth images.

    Args:
        mode: one of `MODES`.
        size: side of the images in pixels.
        num_envs: environments stepped together by `fast`; PyBullet has the first number.
        rounds: of measurements in turn.
        seconds: of each measurement.
    """
    first, *more = num_envs
    with ExitStack() as stack:
        measures = {}
        for name, n in [(FAST, first), (PYBULLET, first), *((FAST, n) for n in more)]:
            env = make_vector_env(
                n,
                rewards=dict.fromkeys(built_in_rewards(), 1.0),
                cameras={"depth": Camera(type="depth", width=size, height=size)},
                frame_grab=MODES[mode],
                simulator=name,
            )
            stack.callback(env.close)
            env.reset()
            play = partial(_play, env, np.random.default_rng(0))
            play()  # compiles
            measures[name, n] = partial(_speed, STEPS, play, seconds)
        return race(measures, size, mode, rounds)


def _speed(what: str, *measured: Any) -> dict[str, float]:
    return {what: rate(*measured)}


def _play(env: GraspVectorEnv, rng: np.random.Generator) -> int:
    """Random actions everywhere, as many as an episode has; returns the steps taken."""
    for _ in range(EPISODE_STEPS):
        env.step(rng.uniform(-1.0, 1.0, (env.num_envs, 4)))
    return EPISODE_STEPS * env.num_envs


class Worlds:
    """Worlds before one camera, with something new in view at every picture."""

    def __init__(self, simulator: str, camera: Camera, num_worlds: int):
        kind = camera.type
        settings = GraspSettings.model_validate(
            {"simulator": simulator, "num_envs": num_worlds, "cameras": {kind: camera}}
        )
        self.simulator = make_simulator(settings, ROBOT, num_worlds)
        self._sample = sample = Sample(num_worlds, (camera.width, camera.height))
        limits = np.full(num_worlds, np.pi)
        sample.scenes, views = SceneSampler(settings).sample(np.random.default_rng(0), limits)
        self._views = views[kind]
        space = observation_space(settings)[kind]
        self._space = space if isinstance(space, DepthImage) else None
        self._rng, self._pictures = np.random.default_rng(0), 0

    def change(self) -> None:
        """Moves all robots, after new scenes where an episode would begin."""
        self.plan()
        self.move()

    def plan(self) -> None:
        """Begins new scenes where an episode would begin, and plans the next motions."""
        sample = self._sample
        if self._pictures % EPISODE_STEPS == 0:
            order = self._rng.permutation(len(sample.scenes))
            sample.scenes, self._views = sample.scenes[order], self._views[order]
            self.simulator.load(sample.everywhere, sample.scenes, sample.start.joints_rad)
        (self._path,) = sample.paths(1)
        self._pictures += 1

    def move(self) -> int:
        """Moves all robots as planned; returns how many."""
        everywhere = self._sample.everywhere
        self.simulator.move(everywhere, self._path, RESOLUTION_M)
        return len(everywhere)

    def shoot(self) -> int:
        """Takes a picture of every world, depth as the sensor delivers it; returns how many."""
        everywhere = self._sample.everywhere
        if self._space is None:
            self.simulator.render(everywhere, self._views)
        else:
            seeds = picture_seeds(self._rng, len(everywhere))
            self.simulator.render_depth(everywhere, self._views, self._space, seeds)
        return len(everywhere)
