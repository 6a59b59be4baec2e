"""The running episodes: the state of a batch of grasp environments from step to step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.robot.arm import Tools
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.settings import Camera
from envs.grasp.task import EpisodeProgress, GoalRegion

BATCHES = {"scenes": Scenes, "region": GoalRegion, "tools": Tools, "progress": EpisodeProgress}


@dataclass(frozen=True)
class RunningEpisodes:
    """N running episodes. Arrays are replaced, never written to: they may be in use elsewhere.

    Attributes:
        scenes: what stands before the robots.
        region: what counts as right.
        tools: where the robots are.
        progress: what has happened.
        views: where each camera stands, by its name.
        images: each camera's latest observation (N, H, W, C), by its name.
    """

    scenes: Scenes
    region: GoalRegion
    tools: Tools
    progress: EpisodeProgress
    views: dict[str, CameraPoses]
    images: dict[str, NDArray[Any]]

    def with_rows(self, indices: NDArray[np.int64], others: RunningEpisodes) -> RunningEpisodes:
        """These, with other episodes at some indices."""
        images = {name: image.copy() for name, image in self.images.items()}
        for name, image in others.images.items():
            images[name][indices] = image
        return RunningEpisodes(
            scenes=self.scenes.with_rows(indices, others.scenes),
            region=self.region.with_rows(indices, others.region),
            tools=self.tools.with_rows(indices, others.tools),
            progress=self.progress.with_rows(indices, others.progress),
            views={n: view.with_rows(indices, others.views[n]) for n, view in self.views.items()},
            images=images,
        )

    def state_dict(self) -> dict[str, Any]:
        """All arrays, by field."""
        return {
            **{name: getattr(self, name).arrays() for name in BATCHES},
            "views": {name: view.arrays() for name, view in self.views.items()},
            "images": dict(self.images),
        }

    @classmethod
    def from_state_dict(
        cls, state: Mapping[str, Any], cameras: Mapping[str, Camera]
    ) -> RunningEpisodes:
        """The episodes of a `state_dict`."""
        return cls(
            **{name: batch(**state[name]) for name, batch in BATCHES.items()},
            views={
                name: CameraPoses(camera, **state["views"][name])
                for name, camera in cameras.items()
            },
            images=dict(state["images"]),
        )
