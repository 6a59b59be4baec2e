"""Scenes: three blocks on a table, what stands around, a light and the cameras, at every reset."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from envs.environment import EnvironmentFailure
from envs.grasp.batch import Batch
from envs.grasp.scene import surroundings
from envs.grasp.scene.dark import draw_dark
from envs.grasp.scene.placement import place_blocks, rules
from envs.grasp.scene.surroundings import SurroundingRules
from envs.grasp.sensors.camera import CameraPoses, sample_views, with_dark
from envs.grasp.sensors.structured_light import StructuredLight
from envs.grasp.settings import GraspSettings, Randomize
from envs.grasp.simulators.thread_pool import ThreadPool

Floats = NDArray[np.float64]


class SceneError(EnvironmentFailure, ValueError):
    """The ranges of the run file leave no room for a scene.

    A mistake in the settings where it shows at the first reset; later on the run ends by it.
    """


@dataclass(frozen=True)
class Scenes(Batch):
    """n scenes with B blocks each, of which block 0 is the target, and K boxes around them.

    Attributes:
        box_center_m, box_half_m: (n, B, 3, 3) boxes of the blocks in their body frames.
        block_position_m: (n, B, 3) body origins, world frame.
        block_yaw_rad: (n, B) yaw of the bodies; a tool with the same yaw faces the block squarely.
        target_m: (n, 3) grasp point of block 0, world frame.
        around_center_m: (n, K, 3) boxes of what is no block, world frame, part by part as
            `envs.grasp.scene.surroundings` has them; K is 0 where nothing stands around.
        around_rotation: (n, K, 3, 3) whose columns are the boxes' axes.
        around_half_m: (n, K, 3) their half extents, zero where there is none.
        light_direction: (n, 3) unit vector towards the light.
        light_intensity: (n,) diffuse share of the light.
    """

    box_center_m: Floats
    box_half_m: Floats
    block_position_m: Floats
    block_yaw_rad: Floats
    target_m: Floats
    around_center_m: Floats
    around_rotation: Floats
    around_half_m: Floats
    light_direction: Floats
    light_intensity: Floats

    @property
    def target_yaw_rad(self) -> Floats:
        """(n,) yaw at which a tool faces the target squarely."""
        return self.block_yaw_rad[:, 0]


def heading(yaw_rad: Floats) -> Floats:
    """Horizontal unit vectors (..., 3) along a yaw (...)."""
    return np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)], axis=-1)


def to_world(points_m: Floats, position_m: Floats, yaw_rad: Floats) -> Floats:
    """Points (..., k, 3) of a body frame at (..., 3) with yaw (...), in the world frame."""
    cosine, sine = np.cos(yaw_rad)[..., None], np.sin(yaw_rad)[..., None]
    x, y, z = np.moveaxis(points_m, -1, 0)
    turned = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)
    return turned + position_m[..., None, :]


class SceneSampler:
    """Draws scenes by rejection: every candidate obeys the ranges, the acceptable ones are kept."""

    def __init__(self, settings: GraspSettings):
        self._settings = settings
        self._rules = rules(settings)
        around = settings.randomize.surroundings
        self._around = None if around is None else surroundings.surrounding_rules(settings, around)
        self._threads = ThreadPool(settings.threads)

    def sample(
        self, rng: np.random.Generator, yaw_limit_rad: Floats
    ) -> tuple[Scenes, dict[str, CameraPoses]]:
        """Draws n scenes and where each of the cameras stands in them.

        Args:
            rng: the source of randomness.
            yaw_limit_rad: (n,) narrows the range of the blocks' yaw to +- this.

        Raises:
            SceneError: no acceptable scene was found in many tries.
        """
        n, blocks, randomize = len(yaw_limit_rad), self._settings.blocks, self._settings.randomize
        boxes = 0 if self._around is None else surroundings.BOXES
        position_m, rotation_deg = randomize.camera_position_m, randomize.camera_rotation_deg
        views = {
            name: sample_views(camera, rng, n, position_m, rotation_deg)
            for name, camera in self._settings.cameras.items()
        }
        scenes = Scenes(
            box_center_m=np.empty((n, blocks, 3, 3)),
            box_half_m=np.empty((n, blocks, 3, 3)),
            block_position_m=np.empty((n, blocks, 3)),
            block_yaw_rad=np.empty((n, blocks)),
            target_m=np.empty((n, 3)),
            around_center_m=np.empty((n, boxes, 3)),
            around_rotation=np.empty((n, boxes, 3, 3)),
            around_half_m=np.empty((n, boxes, 3)),
            light_direction=_light_directions(rng, randomize, n),
            light_intensity=rng.uniform(*randomize.light_intensity, n),
        )
        seeds = rng.integers(2**64, size=n, dtype=np.uint64)
        camera_m = np.stack([view.position_m for view in views.values()], axis=1)
        found = np.empty(n, bool)
        place = partial(
            place_blocks,
            self._rules,
            np.stack([seeds, np.zeros_like(seeds)], axis=1),
            yaw_limit_rad,
            camera_m,
            np.stack([view.rotation for view in views.values()], axis=1),
            np.stack([view.intrinsics for view in views.values()], axis=1),
            scenes.box_center_m,
            scenes.box_half_m,
            scenes.block_position_m,
            scenes.block_yaw_rad,
            scenes.target_m,
            found,
        )
        self._threads.parallel_for(place, n)
        if not found.all():
            raise SceneError(
                f"no scene with {blocks} blocks fits: widen environment.randomize.block_x_m and "
                "block_y_m, lower blocks or target_lead_m, or let the cameras see more (fov_deg, "
                "position_m)"
            )
        if self._around is not None:
            self._surround(self._around, scenes, seeds, camera_m)
        return scenes, {name: self._with_dark(rng, scenes, view) for name, view in views.items()}

    def _with_dark(
        self, rng: np.random.Generator, scenes: Scenes, view: CameraPoses
    ) -> CameraPoses:
        """The same cameras, to which some of what they see is dark."""
        sensor = view.camera.sensor
        if not isinstance(sensor, StructuredLight):
            return view
        boxes = (scenes.box_center_m, scenes.box_half_m)
        dark, missing = draw_dark(
            sensor, self._settings, rng, boxes, scenes.block_position_m, scenes.block_yaw_rad
        )
        return with_dark(view, dark, missing)

    def check(self, scenes: Scenes) -> None:
        """Refuses scenes of a task that draws other arrays.

        Raises:
            ValueError: something stands around in one of the two only.
        """
        if bool(scenes.around_half_m.shape[1]) == (self._around is None):
            theirs, ours = ("with", "without") if self._around is None else ("without", "with")
            raise ValueError(
                f"the scenes were drawn {theirs} environment.randomize.surroundings, and are to go "
                f"on {ours}: set it as it was"
            )

    def _surround(
        self, rules: SurroundingRules, scenes: Scenes, seeds: NDArray[np.uint64], camera_m: Floats
    ) -> None:
        """Draws what stands around, from numbers of its own, so that all else stays as it is."""
        surround = partial(
            surroundings.surround,
            rules,
            np.stack([seeds, np.full_like(seeds, surroundings.OWN_NUMBERS)], axis=1),
            camera_m,
            scenes.box_center_m,
            scenes.box_half_m,
            scenes.block_position_m,
            scenes.block_yaw_rad,
            scenes.target_m,
            scenes.around_center_m,
            scenes.around_rotation,
            scenes.around_half_m,
        )
        self._threads.parallel_for(surround, len(seeds))


def _light_directions(rng: np.random.Generator, randomize: Randomize, n: int) -> Floats:
    """Unit vectors (n, 3) towards the light."""
    azimuth = np.radians(rng.uniform(*randomize.light_azimuth_deg, n))
    elevation = np.radians(rng.uniform(*randomize.light_elevation_deg, n))
    direction = heading(azimuth) * np.cos(elevation)[:, None]
    direction[:, 2] = np.sin(elevation)
    return direction
