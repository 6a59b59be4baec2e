"""All worlds at once in compiled loops, spread over threads: the simulator to train with.

It shows and feels what PyBullet does (`python -m benchmarks.agreement` measures how closely), but
for the tessellation of cylinders, which are exact here.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import DepthImage
from envs.cameras import yaw_rotations
from envs.grasp.robot.kinematics import shape_reach
from envs.grasp.robot.paths import Path, check_knots
from envs.grasp.robot.urdf import Box, Robot
from envs.grasp.scene import surroundings
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses, sampling
from envs.grasp.sensors.depth import NO_SENSOR, Sensor, sensor_of
from envs.grasp.settings import Support, check_resolution
from envs.grasp.simulators.base import Contacts, Floats, Images, Indices
from envs.grasp.simulators.colors import AROUND_RGBA, BLOCK_RGBA, SUPPORT_RGBA
from envs.grasp.simulators.kernels.contacts import touch_along
from envs.grasp.simulators.kernels.pictures import ViewArrays, take_pictures
from envs.grasp.simulators.kernels.worlds import RobotArrays, WorldArrays
from envs.grasp.simulators.thread_pool import ThreadPool

ORTHONORMAL_TOLERANCE = 1e-6
# Pictures that are not asked for.
NO_DEPTHS = np.empty((0, 0, 0), np.float32)
NO_COLORS = np.empty((0, 0, 0, 3), np.uint8)
NO_CODES = np.empty((0, 0, 0), np.uint16)


class FastSimulator:
    """N worlds in this process. Implements `envs.grasp.simulators.base.Simulator`.

    Args:
        num_worlds: N.
        robot: stands in every one of them.
        support: the table.
        threads: among which the worlds are divided; None: one for each core.

    Raises:
        ValueError: `threads` is less than one.
    """

    def __init__(self, num_worlds: int, robot: Robot, support: Support, threads: int | None = None):
        self._threads = ThreadPool(threads)
        self._robot = robot_arrays(robot)
        self._num_worlds, self._support = num_worlds, support
        self._worlds = _empty_worlds(num_worlds, 1, 2, len(self._robot.axes))
        self._loaded = np.zeros(num_worlds, bool)

    def load(self, indices: Indices, scenes: Scenes, joints_rad: Floats) -> None:
        """See `Simulator.load`.

        Raises:
            ValueError: a number is not finite, or a box has a side that is not positive.
        """
        indices = self._checked(indices)
        _check_scenes(scenes, len(indices))
        _check(joints_rad, (len(indices), len(self._robot.axes)), "joints_rad")
        blocks, boxes = scenes.box_half_m.shape[1:3]
        around = scenes.around_half_m.shape[1]
        count, rooms = 1 + blocks * boxes + around, 2 + (len(surroundings.SOLID) if around else 0)
        self._reserve(count, rooms)
        worlds = self._worlds
        center, axes, half = _boxes(scenes)
        worlds.half[indices, count:] = 0.0
        worlds.radius[indices, count:] = 0.0
        worlds.center[indices, 1:count], worlds.half[indices, 1:count] = center, half
        worlds.axes[indices, 1:count] = axes
        worlds.radius[indices, 1:count] = np.linalg.norm(half, axis=-1)
        _set_rooms(worlds, indices, blocks * boxes, around > 0)
        worlds.is_target[indices, 1 : 1 + boxes] = True
        worlds.is_target[indices, 1 + boxes :] = False
        worlds.colors[indices, 1:count] = _box_colors(blocks, boxes, around)
        length = np.linalg.norm(scenes.light_direction, axis=1, keepdims=True)
        worlds.light[indices] = scenes.light_direction / length
        worlds.diffuse[indices] = scenes.light_intensity
        worlds.joints[indices, 0] = joints_rad
        self._loaded[indices] = True

    def move(self, indices: Indices, path_rad: Path, resolution_m: float) -> Contacts:
        """See `Simulator.move`.

        Raises:
            ValueError: a joint angle is not finite, the number of knots is even, the resolution is
                none, or a world holds no scene.
        """
        indices = self._checked(indices, loaded=True)
        check_knots(path_rad)
        check_resolution(resolution_m)
        shape = (len(indices), path_rad.shape[1], len(self._robot.axes))
        _check(path_rad, shape, "path_rad")
        touched, collided = np.zeros(len(indices), bool), np.zeros(len(indices), bool)
        path = np.ascontiguousarray(path_rad, np.float64)
        touch = partial(
            touch_along,
            self._robot,
            self._worlds,
            indices,
            path,
            float(resolution_m),
            touched,
            collided,
        )
        self._threads.parallel_for(touch, len(indices))
        self._worlds.joints[indices, 0] = path[:, -1]
        return Contacts(touched, collided)

    def render(self, indices: Indices, views: CameraPoses) -> Images:
        """See `Simulator.render`.

        Raises:
            ValueError: a view is not possible, or a world holds no scene.
        """
        indices, arrays = self._checked(indices, loaded=True), _view_arrays(views, len(indices))
        size = (len(indices), arrays.height, arrays.width)
        is_color = views.camera.type == "rgb"
        depths = NO_DEPTHS if is_color else np.empty(size, np.float32)
        colors = np.empty((*size, 3), np.uint8) if is_color else NO_COLORS
        self._take_pictures(indices, arrays, NO_SENSOR, depths, colors, NO_CODES)
        return colors if is_color else depths

    def render_depth(
        self, indices: Indices, views: CameraPoses, space: DepthImage, seeds: NDArray[np.uint64]
    ) -> Images:
        """See `Simulator.render_depth`.

        Raises:
            ValueError: a view is not possible, the space has another size than the camera, or a
                world holds no scene.
        """
        indices, arrays = self._checked(indices, loaded=True), _view_arrays(views, len(indices))
        if space.shape != (arrays.height, arrays.width, 1):
            raise ValueError(
                f"the space is {space}, but the camera takes {arrays.width}x{arrays.height} "
                "(width x height)"
            )
        if np.shape(seeds) != indices.shape:
            raise ValueError(f"{len(indices)} pictures need as many seeds, not {np.shape(seeds)}")
        codes = np.empty((len(indices), arrays.height, arrays.width), np.uint16)
        sensor = sensor_of(views, space, seeds)
        self._take_pictures(indices, arrays, sensor, NO_DEPTHS, NO_COLORS, codes)
        return codes[..., None].astype(space.dtype, copy=False)

    def close(self) -> None:
        """See `Simulator.close`."""
        self._threads.close()

    def _take_pictures(
        self,
        indices: Indices,
        views: ViewArrays,
        sensor: Sensor,
        depths: NDArray[np.float32],
        colors: NDArray[np.uint8],
        codes: NDArray[np.uint16],
    ) -> None:
        """Fills pictures (n, H, W) and (n, H, W, 3); those that are not asked for are empty."""
        pixels = views.height * views.width
        take = partial(
            take_pictures,
            self._robot,
            self._worlds,
            indices,
            views,
            sensor,
            depths.reshape(len(depths), pixels if len(depths) else 0),
            colors.reshape(len(colors), pixels if len(colors) else 0, 3),
            codes.reshape(len(codes), pixels if len(codes) else 0),
        )
        self._threads.parallel_for(take, len(indices))

    def _checked(self, indices: Indices, loaded: bool = False) -> Indices:
        """The indices as compiled loops take them, which look at no limits themselves."""
        indices = np.ascontiguousarray(indices, np.int64)
        known = (indices >= 0) & (indices < self._num_worlds)
        if indices.ndim != 1 or not known.all() or (np.diff(indices) <= 0).any():
            raise ValueError(
                f"indices must rise from 0 or more to under {self._num_worlds}, not {indices}"
            )
        if loaded and not self._loaded[indices].all():
            missing = indices[~self._loaded[indices]]
            raise ValueError(f"worlds {missing.tolist()} hold no scene yet: load one first")
        return indices

    def _reserve(self, boxes: int, rooms: int) -> None:
        """Makes place for so many boxes and rooms a world, of which the first is the support's."""
        before = self._worlds
        had = before.half.shape[1], before.low.shape[1]
        if self._loaded.any() and had[0] >= boxes and had[1] >= rooms:
            return
        boxes, rooms = max(boxes, had[0]), max(rooms, had[1])
        self._worlds = _empty_worlds(self._num_worlds, boxes, rooms, len(self._robot.axes))
        for old, new in zip(before, self._worlds, strict=True):
            # Only the axis of the boxes or the rooms, if any, has another length.
            new[tuple(slice(size) for size in old.shape)] = old
        support, worlds = self._support, self._worlds
        (x_low, x_high), (y_low, y_high) = support.x_m, support.y_m
        low = np.array([x_low, y_low, support.top_m - support.thickness_m])
        high = np.array([x_high, y_high, support.top_m])
        worlds.center[:, 0], worlds.half[:, 0] = (low + high) / 2, (high - low) / 2
        worlds.radius[:, 0] = np.linalg.norm(high - low) / 2
        worlds.axes[:, 0] = np.eye(3)
        worlds.colors[:, 0] = _color_levels([SUPPORT_RGBA])[0]


def robot_arrays(robot: Robot) -> RobotArrays:
    """The robot as the kernels take it."""
    shapes = [
        (link, shape) for link, shapes in enumerate(robot.link_primitives) for shape in shapes
    ]
    half = np.array(
        [
            shape.half_extents_m
            if isinstance(shape, Box)
            else (shape.radius_m, shape.radius_m, shape.length_m / 2)
            for _, shape in shapes
        ]
    )
    is_cylinder = np.array([not isinstance(shape, Box) for _, shape in shapes])
    links = np.array([link for link, _ in shapes], np.int64)
    return RobotArrays(
        parents=np.array(robot.link_parents, np.int64),
        joints=np.array(robot.link_joints, np.int64),
        origins=np.ascontiguousarray(robot.link_origins),
        axes=np.ascontiguousarray(robot.joint_axes),
        shape_links=links,
        shape_poses=np.array([shape.pose for _, shape in shapes]),
        shape_half=half,
        shape_radius=np.array([shape.bounding_radius_m for _, shape in shapes]),
        shape_reach=shape_reach(robot),
        is_cylinder=is_cylinder,
        is_cup=links == robot.cup_link,
        shape_colors=_color_levels(robot.link_colors[links]),
    )


def _empty_worlds(worlds: int, boxes: int, rooms: int, joints: int) -> WorldArrays:
    return WorldArrays(
        center=np.zeros((worlds, boxes, 3)),
        axes=np.zeros((worlds, boxes, 3, 3)),
        half=np.zeros((worlds, boxes, 3)),
        radius=np.zeros((worlds, boxes)),
        starts=np.zeros((worlds, rooms + 1), np.int64),
        low=np.full((worlds, rooms, 3), np.inf),
        high=np.full((worlds, rooms, 3), -np.inf),
        is_target=np.zeros((worlds, boxes), bool),
        colors=np.zeros((worlds, boxes, 3)),
        light=np.zeros((worlds, 3)),
        diffuse=np.zeros(worlds),
        joints=np.zeros((worlds, 1, joints)),
    )


def _boxes(scenes: Scenes) -> tuple[Floats, Floats, Floats]:
    """Centres (n, k, 3), axes (n, k, 3, 3) and half extents (n, k, 3) in the world frame.

    First come the blocks', then what stands around.
    """
    n, blocks, boxes = scenes.box_half_m.shape[:3]
    turn = yaw_rotations(scenes.block_yaw_rad)
    center = scenes.block_position_m[:, :, None] + np.matmul(
        scenes.box_center_m, np.swapaxes(turn, -1, -2)
    )
    axes = np.broadcast_to(turn[:, :, None], (n, blocks, boxes, 3, 3))
    return (
        np.concatenate([center.reshape(n, -1, 3), scenes.around_center_m], axis=1),
        np.concatenate([axes.reshape(n, -1, 3, 3), scenes.around_rotation], axis=1),
        np.concatenate([scenes.box_half_m.reshape(n, -1, 3), scenes.around_half_m], axis=1),
    )


def _box_colors(blocks: int, boxes: int, around: int) -> Floats:
    """Colors (k, 3) of the boxes of `_boxes`."""
    rgba = [BLOCK_RGBA[number % len(BLOCK_RGBA)] for number in range(blocks)]
    of_blocks = np.repeat(_color_levels(rgba), boxes, axis=0)
    return np.concatenate([of_blocks, _color_levels(AROUND_RGBA)[:around]])


def _set_rooms(worlds: WorldArrays, indices: Indices, blocks: int, around: bool) -> None:
    """Sets the rooms of some worlds: of the support, of the blocks' boxes, and of those around."""
    first = 1 + blocks
    parts = [slice(0, 1), slice(1, first)]
    if around:
        parts += [slice(first + part.start, first + part.stop) for part in surroundings.SOLID]
    center, half = worlds.center[indices], worlds.half[indices]
    reach = np.matmul(np.abs(worlds.axes[indices]), half[..., None])[..., 0]
    there = worlds.radius[indices, :, None] > 0.0
    low, high = np.where(there, center - reach, np.inf), np.where(there, center + reach, -np.inf)
    worlds.starts[indices], worlds.low[indices], worlds.high[indices] = (
        parts[-1].stop,
        np.inf,
        -np.inf,
    )
    for room, part in enumerate(parts):
        worlds.starts[indices, room] = part.start
        worlds.low[indices, room] = low[:, part].min(axis=1)
        worlds.high[indices, room] = high[:, part].max(axis=1)


def _view_arrays(views: CameraPoses, n: int) -> ViewArrays:
    """Camera poses as the kernels take them; there must be n, all possible ones."""
    _check(views.position_m, (n, 3), "position_m of the views")
    _check(views.rotation, (n, 3, 3), "rotation of the views")
    _check(views.intrinsics, (n, 4), "intrinsics of the views")
    _check(views.near_m, (n,), "near_m of the views")
    _check(views.far_m, (n,), "far_m of the views")
    square = np.matmul(np.swapaxes(views.rotation, 1, 2), views.rotation)
    if (np.abs(square - np.eye(3)) > ORTHONORMAL_TOLERANCE).any():
        raise ValueError("rotation of the views must be rotations: orthonormal columns")
    if not (views.intrinsics[:, :2] > 0.0).all():
        raise ValueError("intrinsics of the views: focal lengths must be over 0")
    if not ((views.near_m > 0.0) & (views.near_m < views.far_m)).all():
        raise ValueError("near_m of the views must be over 0 and under far_m")
    taken = sampling(views.camera)
    return ViewArrays(
        np.ascontiguousarray(views.position_m, np.float64),
        np.ascontiguousarray(views.rotation, np.float64),
        np.ascontiguousarray(views.near_m, np.float64),
        np.ascontiguousarray(views.far_m, np.float64),
        np.ascontiguousarray(views.intrinsics, np.float64),
        taken.width,
        taken.height,
    )


def _color_levels(rgb: object) -> Floats:
    """Colors in [0, 1], with or without alpha, as whole levels in [0, 255] (n, 3)."""
    return np.floor(255.0 * np.asarray(rgb, np.float64)[:, :3])


def _check_scenes(scenes: Scenes, n: int) -> None:
    if scenes.box_half_m.ndim != 4 or len(scenes) != n:
        raise ValueError(
            f"{n} worlds need {n} scenes with boxes (n, B, k, 3), not {scenes.box_half_m.shape}"
        )
    blocks = scenes.box_half_m.shape[1]
    _check(scenes.box_center_m, scenes.box_half_m.shape, "box_center_m of the scenes")
    _check(scenes.box_half_m, (n, *scenes.box_half_m.shape[1:3], 3), "box_half_m of the scenes")
    _check(scenes.block_position_m, (n, blocks, 3), "block_position_m of the scenes")
    _check(scenes.block_yaw_rad, (n, blocks), "block_yaw_rad of the scenes")
    around = scenes.around_half_m.shape[1]
    if around not in (0, surroundings.BOXES):
        raise ValueError(f"around_half_m of the scenes has {around} boxes, not 0 or all the parts'")
    _check(scenes.around_center_m, (n, around, 3), "around_center_m of the scenes")
    _check(scenes.around_rotation, (n, around, 3, 3), "around_rotation of the scenes")
    _check(scenes.around_half_m, (n, around, 3), "around_half_m of the scenes")
    _check(scenes.light_direction, (n, 3), "light_direction of the scenes")
    _check(scenes.light_intensity, (n,), "light_intensity of the scenes")
    sides = scenes.box_half_m > 0.0
    if not (sides.all(axis=-1) | (scenes.box_half_m == 0.0).all(axis=-1)).all():
        raise ValueError(
            "box_half_m of the scenes: a box has three sides over 0, or all 0 where there is none"
        )
    if not scenes.light_direction.any(axis=1).all():
        raise ValueError("light_direction of the scenes must have a length")


def _check(array: Floats, shape: tuple[int, ...], name: str) -> None:
    if np.shape(array) != shape:
        raise ValueError(f"{name} must be of shape {shape}, not {np.shape(array)}")
    if not np.isfinite(array).all():
        count = np.count_nonzero(~np.isfinite(array))
        raise ValueError(f"{name} must be finite, but {count} of its numbers are not")
