"""The running episodes: the state of a batch of grasp environments from step to step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.robot.arm import Tools
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.settings import Camera
from envs.grasp.task import EpisodeProgress, GoalRegion

BATCHES: dict[str, Any] = {
    "scenes": Scenes,
    "region": GoalRegion,
    "tools": Tools,
    "progress": EpisodeProgress,
}


@dataclass(frozen=True)
class RunningEpisodes:
    """N running episodes. Arrays are replaced, never written to: they may be in use elsewhere.

    Attributes:
        scenes: what stands before the robots.
        region: what counts as right.
        tools: where the robots are.
        progress: what has happened.
        views: where each camera stands, by its name.
        images: each camera's latest observation (N, H, W, C) or (N, P, 4), by its name.
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
        """The episodes of a `state_dict`.

        Raises:
            ValueError: it has other arrays, or other cameras.
        """
        for name, batch in BATCHES.items():
            _check_names(name, state.get(name, {}), batch)
        _check_equal("cameras", state.get("views", {}), cameras)
        for name, arrays in state["views"].items():
            _check_names(f"views.{name}", arrays, CameraPoses)
        return cls(
            **{name: batch(**state[name]) for name, batch in BATCHES.items()},
            views={
                name: CameraPoses(camera, **state["views"][name])
                for name, camera in cameras.items()
            },
            images=dict(state["images"]),
        )


def _check_names(path: str, arrays: Mapping[str, Any], batch: Any) -> None:
    """Raises ValueError where arrays are not those of a batch."""
    names = {field.name for field in fields(batch)} - {"camera"}
    _check_equal(path, arrays, names)


def _check_equal(path: str, found: Iterable[str], expected: Iterable[str]) -> None:
    if differing := sorted(set(found) ^ set(expected)):
        raise ValueError(
            f"the saved episodes are of another version of the grasp task: {path} differs in "
            f"{', '.join(differing)}"
        )
