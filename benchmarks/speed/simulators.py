"""Pictures per second of the simulators: the robot, the support and three blocks in view."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial

import numpy as np

from benchmarks.agreement import Sample
from benchmarks.speed.environments import EPISODE_STEPS
from benchmarks.speed.figures import FAST, PYBULLET, Case, Figure
from benchmarks.speed.timing import Samples, interleave, rate
from encoders.spaces import DepthImage
from envs.grasp.observations import observation_space
from envs.grasp.settings import Camera, GraspSettings
from envs.grasp.simulators.factory import make_simulator

WHATS = {"depth": "depth frames", "rgb": "color frames"}


def measure(size: int, num_worlds: int, repeats: int, seconds: float) -> list[Figure]:
    """Measures both simulators, on all cores.

    Args:
        size: side of the images in pixels.
        num_worlds: taken at once.
        repeats: rounds.
        seconds: of each measurement.
    """
    figures = []
    for kind, what in WHATS.items():
        case = Case(what, size, "", num_worlds)
        with ExitStack() as stack:
            sets = {name: _Set(name, kind, size, num_worlds) for name in (FAST, PYBULLET)}
            for one in sets.values():
                stack.callback(one.simulator.close)
                rate(one.shoot, 0.0, one.change)  # compiles, and starts processes
            measures = {
                name: partial(rate, one.shoot, seconds, one.change) for name, one in sets.items()
            }
            found = interleave(measures, repeats)
        figures += [Figure(case, name, Samples(tuple(rates))) for name, rates in found.items()]
    return figures


class _Set:
    """Worlds before one kind of camera, with something new in view at every picture."""

    def __init__(self, simulator: str, kind: str, size: int, num_worlds: int):
        camera = Camera.model_validate({"type": kind, "width": size, "height": size})
        settings = GraspSettings.model_validate(
            {"simulator": simulator, "num_envs": num_worlds, "cameras": {kind: camera}}
        )
        self.simulator = make_simulator(settings, num_worlds)
        self._sample = Sample(num_worlds, (size, size))
        self._views = self._sample.views[kind]
        space = observation_space(settings)[kind]
        self._space = space if isinstance(space, DepthImage) else None
        self._rng, self._pictures = np.random.default_rng(0), 0

    def change(self) -> None:
        """Moves all robots, after new scenes where an episode would begin."""
        sample = self._sample
        if self._pictures % EPISODE_STEPS == 0:
            order = self._rng.permutation(len(sample.scenes))
            sample.scenes, self._views = sample.scenes[order], self._views[order]
            self.simulator.load(sample.everywhere, sample.scenes, sample.start.joints_rad)
        self.simulator.move(sample.everywhere, *sample.paths(1))
        self._pictures += 1

    def shoot(self) -> int:
        """Takes a picture of every world, depth as the sensor delivers it; returns how many."""
        everywhere = self._sample.everywhere
        if self._space is None:
            self.simulator.render(everywhere, self._views)
        else:
            seeds = self._rng.integers(2**63, size=len(everywhere), dtype=np.uint64)
            self.simulator.render_depth(everywhere, self._views, self._space, seeds)
        return len(everywhere)
