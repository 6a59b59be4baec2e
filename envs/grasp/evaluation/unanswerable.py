"""Images in which there is nothing to grasp: a policy should be sure of no answer to them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from encoders.cameras import Pinhole
from encoders.spaces import DepthImage
from envs.evaluation import Unanswerable
from envs.grasp.observations import (
    image_spaces,
    observed,
    picture_seeds,
    take_images,
)
from envs.grasp.parameters import YAW_LIMIT, parameter_ranges
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.urdf import Robot
from envs.grasp.scene.sampler import Scenes, SceneSampler
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.sensors.depth import sense_depth
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.base import Simulator
from envs.grasp.simulators.factory import make_simulator

Floats = NDArray[np.floating]
Images = dict[str, NDArray[Any]]
Spaces = Mapping[str, Any]
DrawDepth = Callable[[np.random.Generator, Floats, tuple[float, float]], Floats]
"""Generator, rays (n, H, W, 3) and a camera's range -> depths (n, H, W) in metres."""

OUT_OF_SIGHT_M = -100.0
BEYOND_REACH_M = (0.05, 0.35)
TILT_DEG = 65.0
BEYOND_RANGE = 1.1
FAR_M = 1000.0  # of what is not hit at all
BALLS = 3
BALL_RADIUS_M = (0.04, 0.15)
WRONG_SCALE = (1.15, 1.6)


def unanswerable(
    settings: GraspSettings, robot: Robot, count: int, seed: int
) -> Iterator[Unanswerable]:
    """Images of scenes that can't be answered, as the cameras of a task deliver them.

    Args:
        settings: the task.
        robot: stands in the scenes.
        count: how many of each kind.
        seed: of all that is drawn.
    """
    rng = np.random.default_rng(seed)
    whole_yaw = np.full(count, np.radians(parameter_ranges(settings)[YAW_LIMIT].high))
    scenes, views = SceneSampler(settings).sample(rng, whole_yaw)
    for one in _images(settings, robot, rng, scenes, views):
        yield replace(one, observations=observed(one.observations, views, rng))


def _images(
    settings: GraspSettings,
    robot: Robot,
    rng: np.random.Generator,
    scenes: Scenes,
    views: Mapping[str, CameraPoses],
) -> Iterator[Unanswerable]:
    """The same as the sensors' images."""
    count, spaces = len(scenes), image_spaces(settings)
    drawn = partial(_drawn, rng, views, spaces)
    with closing(make_simulator(settings, robot, count)) as simulator:
        take = partial(_taken, rng, views, spaces, simulator, Arm.of(settings, robot))
        ordinary = take(scenes)
        yield Unanswerable("no block", take(_moved(scenes, 2, np.full(count, OUT_OF_SIGHT_M))))
        nearest_m = settings.workspace.x_m[1] + rng.uniform(*BEYOND_REACH_M, count)
        ahead_m = nearest_m - scenes.target_m[:, 0]
        yield Unanswerable("out of reach", take(_moved(scenes, 0, ahead_m)))
    yield Unanswerable("a plane", drawn(_plane))
    yield Unanswerable("planes", drawn(_nearest_planes))
    yield Unanswerable("nothing seen", {k: np.zeros_like(v) for k, v in ordinary.items()})
    yield Unanswerable("noise", drawn(_noise))
    # Those that are least wrong look much like what can be answered: they set no threshold.
    yield Unanswerable("another unit", _scaled(rng, ordinary), use="learn")
    unforeseen = partial(Unanswerable, use="measure")
    yield unforeseen("a corner", drawn(_farthest_planes))
    yield unforeseen("balls", drawn(_balls))
    yield unforeseen("one depth", drawn(_constant))
    yield unforeseen("upside down", {k: v[:, ::-1, ::-1].copy() for k, v in ordinary.items()})


def _moved(scenes: Scenes, axis: int, distance_m: Floats) -> Scenes:
    """The same scenes with all blocks moved along an axis of the world by (n,)."""
    position_m = scenes.block_position_m.copy()
    position_m[..., axis] += distance_m[:, None]
    return replace(scenes, block_position_m=position_m)


def _taken(
    rng: np.random.Generator,
    views: Mapping[str, CameraPoses],
    spaces: Spaces,
    simulator: Simulator,
    arm: Arm,
    scenes: Scenes,
) -> Images:
    """Images of scenes, with the robot at home."""
    indices = np.arange(len(scenes))
    simulator.load(indices, scenes, arm.home(len(scenes)).joints_rad)
    return take_images(simulator, indices, views, spaces, rng)


def _drawn(
    rng: np.random.Generator,
    views: Mapping[str, CameraPoses],
    spaces: Spaces,
    draw: DrawDepth,
) -> Images:
    """Images of drawn depths, through the sensor; those in colours are of one colour each."""
    images: Images = {}
    for name, view in views.items():
        space, count = spaces[name], len(view)
        if isinstance(space, DepthImage):
            height, width, _ = space.shape
            rays = np.stack([Pinhole(*i).rays(height, width) for i in view.intrinsics])
            depth_m = draw(rng, rays.astype(np.float32), space.range_m).astype(np.float32)
            images[name] = sense_depth(depth_m, view, space, picture_seeds(rng, count))
        else:
            colors = rng.integers(256, size=(count, 1, 1, 3), dtype=np.uint8)
            images[name] = np.broadcast_to(colors, (count, *space.shape)).copy()
    return images


def _plane(rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]) -> Floats:
    """A plane across the optical axis within the range and somewhat beyond, tilted anyhow."""
    return 1.0 / _inverse_plane(rng, rays, range_m)


def _inverse_plane(rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]) -> Floats:
    """One over a plane's depths, in which it is linear."""
    count = len(rays)
    slope = np.tan(np.radians(rng.uniform(0.0, TILT_DEG, count)))
    turn = rng.uniform(0.0, 2.0 * np.pi, count)
    nearest_m, farthest_m = range_m[0], BEYOND_RANGE * range_m[1]
    # 1 / z = (1 + a x + b y) / z of the point on the optical axis
    factors = np.stack([slope * np.cos(turn), slope * np.sin(turn), np.ones(count)], axis=1)
    factors /= rng.uniform(nearest_m, farthest_m, (count, 1))
    inverse = np.matmul(rays.reshape(count, -1, 3), factors[:, :, None].astype(rays.dtype))
    return np.maximum(inverse.reshape(rays.shape[:3]), 1.0 / FAR_M)


def _inverse_planes(rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]) -> Floats:
    """The same of two or three planes, (3, n, H, W); where there are two, the first is twice."""
    planes = np.stack([_inverse_plane(rng, rays, range_m) for _ in range(3)])
    two = rng.random(len(rays)) < 0.5
    planes[2, two] = planes[0, two]
    return planes


def _nearest_planes(rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]) -> Floats:
    return np.asarray(1.0 / _inverse_planes(rng, rays, range_m).max(axis=0))


def _farthest_planes(
    rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]
) -> Floats:
    return np.asarray(1.0 / _inverse_planes(rng, rays, range_m).min(axis=0))


def _noise(rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]) -> Floats:
    """Every pixel for itself, in the whole range or a part of it."""
    ends = np.sort(rng.uniform(*range_m, (2, len(rays))), axis=0)[..., None, None]
    return rng.uniform(ends[0], ends[1], rays.shape[:3])


def _constant(rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]) -> Floats:
    return np.broadcast_to(rng.uniform(*range_m, (len(rays), 1, 1)), rays.shape[:3])


def _balls(rng: np.random.Generator, rays: Floats, range_m: tuple[float, float]) -> Floats:
    """Balls before a plane."""
    depth_m, count = _plane(rng, rays, range_m), len(rays)
    square = (rays**2).sum(axis=-1)
    for _ in range(BALLS):
        row, column = (rng.integers(side, size=count) for side in rays.shape[1:3])
        center_m = rays[np.arange(count), row, column] * rng.uniform(*range_m, (count, 1))
        radius_m = rng.uniform(*BALL_RADIUS_M, count)
        # |z ray - center|^2 = radius^2, of which the nearer z is seen
        along = np.matmul(rays.reshape(count, -1, 3), center_m[:, :, None].astype(rays.dtype))
        along = along.reshape(rays.shape[:3])
        rest = ((center_m**2).sum(axis=-1) - radius_m**2)[:, None, None]
        root = along**2 - square * rest
        hit_m = (along - np.sqrt(np.maximum(root, 0.0))) / square
        depth_m = np.where((root > 0.0) & (hit_m > 0.0), np.minimum(depth_m, hit_m), depth_m)
    return np.asarray(depth_m)


def _scaled(rng: np.random.Generator, images: Images) -> Images:
    """Depths in a unit that is not that of training; colours are turned round."""
    scaled: Images = {}
    for name, image in images.items():
        if image.shape[-1] == 1:
            scale = rng.uniform(*WRONG_SCALE, (len(image), 1, 1, 1))
            scale **= rng.choice([-1.0, 1.0], scale.shape)
            codes = (image * scale).clip(0, np.iinfo(image.dtype).max)
            scaled[name] = codes.astype(image.dtype)
        else:
            scaled[name] = 255 - image
    return scaled
