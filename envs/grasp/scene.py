"""Scenes: three blocks on a table, a light and the cameras, drawn at every reset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.grasp.batch import Batch
from envs.grasp.blocks import SHAPE_CODES, Blocks, sample_blocks
from envs.grasp.camera import Views, in_view, sample_views
from envs.grasp.settings import GraspSettings

Floats = NDArray[np.float64]

# Air between the footprints of two blocks, so that touching one is not touching the other.
BLOCK_CLEARANCE_M = 0.02
# The goal lies up to 2 cm in front of a face; so far inside the workspace a grasp point must be.
WORKSPACE_MARGIN_M = 0.03
CANDIDATES_PER_SCENE = 8
MAX_ROUNDS = 400


class SceneError(ValueError):
    """The ranges of the run file leave no room for a scene."""


@dataclass(frozen=True)
class Scenes(Batch):
    """n scenes with B blocks each; block 0 is the target.

    Attributes:
        box_center_m, box_half_m: (n, B, 3, 3) boxes of the blocks in their body frames.
        block_position_m: (n, B, 3) body origins, world frame.
        block_yaw_rad: (n, B) yaw of the bodies; a tool with the same yaw faces the block squarely.
        target_m: (n, 3) grasp point of block 0, world frame.
        light_direction: (n, 3) unit vector towards the light.
        light_intensity: (n,) diffuse share of the light.
    """

    box_center_m: Floats
    box_half_m: Floats
    block_position_m: Floats
    block_yaw_rad: Floats
    target_m: Floats
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


def _footprints(size_m: Floats, position_m: Floats, yaw_rad: Floats, grow_m: float) -> Floats:
    """Corners (n, B, 4, 2) of the blocks seen from above, grown by `grow_m` on every side."""
    depth, width = size_m[..., 0], size_m[..., 1]
    x = np.stack([0 * depth, depth, depth, 0 * depth], axis=-1) + grow_m * np.array([-1, 1, 1, -1])
    y = width[..., None] / 2 * np.array([-1, -1, 1, 1]) + grow_m * np.array([-1, -1, 1, 1])
    return to_world(np.stack([x, y, 0 * x], axis=-1), position_m, yaw_rad)[..., :2]


def _overlap(first: Floats, second: Floats, yaw_first: Floats, yaw_second: Floats) -> NDArray:
    """Whether rectangles (n, 4, 2) overlap, by the separating axes along both pairs of sides."""
    separated = np.zeros(len(first), bool)
    for yaw in (yaw_first, yaw_second):
        for axis in (heading(yaw)[:, :2], heading(yaw + np.pi / 2)[:, :2]):
            a, b = (np.einsum("nkd,nd->nk", corners, axis) for corners in (first, second))
            separated |= (a.max(1) < b.min(1)) | (b.max(1) < a.min(1))
    return ~separated


class SceneSampler:
    """Draws scenes by rejection: every candidate obeys the ranges, the acceptable ones are kept."""

    def __init__(self, settings: GraspSettings):
        self._settings = settings

    def sample(
        self, rng: np.random.Generator, yaw_limit_rad: Floats
    ) -> tuple[Scenes, dict[str, Views]]:
        """Draws n scenes and where each of the cameras stands in them.

        Args:
            rng: the source of randomness.
            yaw_limit_rad: (n,) narrows the range of the blocks' yaw to +- this.

        Raises:
            SceneError: no acceptable scene was found in many tries.
        """
        n, randomize = len(yaw_limit_rad), self._settings.randomize
        views = {
            name: sample_views(
                camera, rng, n, randomize.camera_position_m, randomize.camera_rotation_deg
            )
            for name, camera in self._settings.cameras.items()
        }
        scenes: Scenes | None = None
        missing = np.arange(n)
        for _ in range(MAX_ROUNDS):
            owner = np.repeat(missing, CANDIDATES_PER_SCENE)
            candidates, good = self._candidates(
                rng, {name: view[owner] for name, view in views.items()}, yaw_limit_rad[owner]
            )
            scenes = candidates[:n] if scenes is None else scenes
            found, first = np.unique(owner[good], return_index=True)
            scenes = scenes.with_rows(found, candidates[np.flatnonzero(good)[first]])
            missing = np.setdiff1d(missing, found, assume_unique=True)
            if not len(missing):
                return scenes, views
        raise SceneError(
            f"no scene with {self._settings.blocks} blocks fits: widen environment.randomize."
            "block_x_m and block_y_m, lower blocks or target_lead_m, or let the cameras see more "
            "(fov_deg, position_m)"
        )

    def _candidates(
        self, rng: np.random.Generator, views: dict[str, Views], yaw_limit_rad: Floats
    ) -> tuple[Scenes, NDArray[np.bool_]]:
        """Draws one candidate for every view, and tells which are acceptable."""
        settings, randomize = self._settings, self._settings.randomize
        n, count = len(yaw_limit_rad), settings.blocks
        x = rng.uniform(*randomize.block_x_m, (n, count))
        y = rng.uniform(*randomize.block_y_m, (n, count))
        low, high = np.radians(randomize.block_yaw_deg)
        limit = yaw_limit_rad[:, None]
        yaw = rng.uniform(np.clip(low, -limit, limit), np.clip(high, -limit, limit), (n, count))
        position = np.stack([x, y, np.full_like(x, settings.support.top_m)], axis=-1)
        codes = np.array([SHAPE_CODES[shape] for shape in randomize.shapes])
        blocks = sample_blocks(
            rng,
            rng.choice(codes, n * count),
            randomize.block_size_m,
            randomize.block_depth_m,
        )
        size = blocks.size_m.reshape(n, count, 3)

        distance = np.hypot(x, y)
        order = np.argsort(distance, axis=1)
        rows = np.arange(n)[:, None]
        position, yaw, size = position[rows, order], yaw[rows, order], size[rows, order]
        scenes = Scenes(
            blocks.center_m.reshape(n, count, 3, 3)[rows, order],
            blocks.half_m.reshape(n, count, 3, 3)[rows, order],
            position,
            yaw,
            self._target(blocks, rows[:, 0] * count + order[:, 0], position[:, 0], yaw[:, 0]),
            *self._light(rng, n),
        )
        ranked = distance[rows, order]
        good = np.ones(n, bool)
        if count > 1:
            good &= ranked[:, 1] - ranked[:, 0] >= settings.target_lead_m
        good &= self._apart(size, position, yaw) & self._on_support(size, position, yaw)
        good &= self._reachable(scenes.target_m, yaw[:, 0])
        good &= self._seen(views, size, position, yaw)
        return scenes, good

    def _target(
        self, blocks: Blocks, index: NDArray[np.int64], position: Floats, yaw: Floats
    ) -> Floats:
        centroid = self._settings.grasp_point == "centroid"
        on_face = (blocks.centroid_m if centroid else blocks.disc_m)[index]
        local = np.concatenate([np.zeros((len(index), 1)), on_face], axis=1)
        return to_world(local[:, None], position, yaw)[:, 0]

    def _light(self, rng: np.random.Generator, n: int) -> tuple[Floats, Floats]:
        randomize = self._settings.randomize
        azimuth = np.radians(rng.uniform(*randomize.light_azimuth_deg, n))
        elevation = np.radians(rng.uniform(*randomize.light_elevation_deg, n))
        direction = heading(azimuth) * np.cos(elevation)[:, None]
        direction[:, 2] = np.sin(elevation)
        return direction, rng.uniform(*randomize.light_intensity, n)

    def _apart(self, size: Floats, position: Floats, yaw: Floats) -> NDArray[np.bool_]:
        corners = _footprints(size, position, yaw, BLOCK_CLEARANCE_M / 2)
        good = np.ones(len(size), bool)
        for i in range(size.shape[1]):
            for j in range(i):
                good &= ~_overlap(corners[:, i], corners[:, j], yaw[:, i], yaw[:, j])
        return good

    def _on_support(self, size: Floats, position: Floats, yaw: Floats) -> NDArray[np.bool_]:
        support = self._settings.support
        low = np.array([support.x_m[0], support.y_m[0]])
        high = np.array([support.x_m[1], support.y_m[1]])
        corners = _footprints(size, position, yaw, 0.0)
        return np.asarray(((corners >= low) & (corners <= high)).all(axis=(1, 2, 3)))

    def _reachable(self, target_m: Floats, yaw: Floats) -> NDArray[np.bool_]:
        workspace = self._settings.workspace
        low, high = np.array([workspace.x_m, workspace.y_m, workspace.z_m]).T
        inside = (target_m >= low + WORKSPACE_MARGIN_M) & (target_m <= high - WORKSPACE_MARGIN_M)
        low_yaw, high_yaw = np.radians(workspace.yaw_deg)
        return inside.all(axis=1) & (yaw >= low_yaw) & (yaw <= high_yaw)

    def _seen(
        self, views: dict[str, Views], size: Floats, position: Floats, yaw: Floats
    ) -> NDArray[np.bool_]:
        """Every block's face lies inside the image of every camera."""
        half_width, height = size[..., 1] / 2, size[..., 2]
        y = half_width[..., None] * np.array([-1, 1, -1, 1])
        z = height[..., None] * np.array([0, 0, 1, 1])
        faces = to_world(np.stack([0 * y, y, z], axis=-1), position, yaw)
        faces = faces.reshape(len(size), -1, 3)
        return np.logical_and.reduce([in_view(view, faces) for view in views.values()])
