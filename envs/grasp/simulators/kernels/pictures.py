"""Pictures of many worlds at once: depth, color, and depth as the sensor delivers it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grasp.sensors.depth import Sensor, sense, workbench
from envs.grasp.simulators.kernels.raster import (
    FAST,
    Canvas,
    Lens,
    Light,
    canvas,
    draw_box,
    draw_cylinder,
    in_sight,
)
from envs.grasp.simulators.kernels.worlds import (
    Floats,
    Integers,
    RobotArrays,
    Vector,
    WorldArrays,
    column_in_world,
    dot,
    in_world,
    kernel,
    minus,
    move_links,
    triple,
)

WHITE = 0xFFFFFF


class ViewArrays(NamedTuple):
    """n cameras of one kind; see `envs.grasp.sensors.camera.CameraPoses`."""

    position: Floats
    rotation: Floats
    near_m: Floats
    far_m: Floats
    intrinsics: Floats
    width: int
    height: int


class Eye(NamedTuple):
    """Position of one camera, and its axes in the world."""

    position: Vector
    right: Vector
    down: Vector
    forward: Vector


@kernel(nogil=True)
def take_pictures(
    robot: RobotArrays,
    worlds: WorldArrays,
    indices: Integers,
    views: ViewArrays,
    sensor: Sensor,
    depths: NDArray[np.float32],
    colors: NDArray[np.uint8],
    codes: NDArray[np.uint16],
    begin: int,
    end: int,
) -> None:
    """Takes a picture in each of some worlds. One kernel for all kinds: it takes long to compile.

    Args:
        robot: the robot.
        worlds: where everything is.
        indices: (n,) the worlds.
        views: the cameras.
        sensor: for the codes.
        depths: (n, H * W) written: metres, infinite where nothing is seen. Empty where they are not
            asked for, as the following are.
        colors: (n, H * W, 3) written: RGB.
        codes: (n, H * W) written: what the sensor delivers.
        begin: first row that is meant.
        end: row before which to end.
    """
    picture = canvas(views.height, views.width, len(colors) > 0)
    frames = np.empty((len(robot.parents), 3, 4))
    bench = workbench(sensor, views.height * views.width)
    for row in range(begin, end):
        _draw_world(picture, robot, worlds, indices[row], views, row, frames)
        if len(depths):
            _to_depth(picture.inverse, depths[row])
        if len(colors):
            _to_color(picture.colors, colors[row])
        if len(codes):
            sense(picture.inverse, True, sensor, row, bench, codes[row])


@kernel(counts=False)
def _to_color(packed: NDArray[np.int32], color: NDArray[np.uint8]) -> None:
    for pixel in range(len(color)):
        color[pixel, 0] = packed[pixel] >> 16
        color[pixel, 1] = (packed[pixel] >> 8) & 255
        color[pixel, 2] = packed[pixel] & 255


@kernel(counts=False, fastmath=FAST)
def _to_depth(inverse: NDArray[np.float32], depth: NDArray[np.float32]) -> None:
    for pixel in range(len(depth)):
        value = inverse[pixel]
        depth[pixel] = np.float32(1.0) / value if value > np.float32(0.0) else np.float32(np.inf)


@kernel(counts=False)
def _draw_world(
    picture: Canvas,
    robot: RobotArrays,
    worlds: WorldArrays,
    world: int,
    views: ViewArrays,
    row: int,
    frames: Floats,
) -> None:
    """Draws everything in a world; `frames` (L, 3, 4) is room for the robot's links."""
    for pixel in range(len(picture.inverse)):
        picture.inverse[pixel] = 0.0
    for pixel in range(len(picture.colors)):
        picture.colors[pixel] = WHITE
    lens = Lens(
        views.intrinsics[row, 0],
        views.intrinsics[row, 1],
        views.intrinsics[row, 2],
        views.intrinsics[row, 3],
        views.width,
        views.height,
        views.near_m[row],
        views.far_m[row],
    )
    eye = Eye(
        (views.position[row, 0], views.position[row, 1], views.position[row, 2]),
        (views.rotation[row, 0, 0], views.rotation[row, 1, 0], views.rotation[row, 2, 0]),
        (views.rotation[row, 0, 1], views.rotation[row, 1, 1], views.rotation[row, 2, 1]),
        (views.rotation[row, 0, 2], views.rotation[row, 1, 2], views.rotation[row, 2, 2]),
    )
    diffuse = worlds.diffuse[world]
    sun = (worlds.light[world, 0], worlds.light[world, 1], worlds.light[world, 2])
    light = Light(_turned(eye, sun), 1.0 - diffuse, diffuse)
    middles, axes, halves, colors = worlds.center, worlds.axes, worlds.half, worlds.colors
    for box in range(halves.shape[1]):
        radius = worlds.radius[world, box]
        center = _placed(eye, triple(middles, world, box))
        if radius == 0.0 or not in_sight(center, radius, lens):
            continue
        x_axis = _turned(
            eye, (axes[world, box, 0, 0], axes[world, box, 1, 0], axes[world, box, 2, 0])
        )
        y_axis = _turned(
            eye, (axes[world, box, 0, 1], axes[world, box, 1, 1], axes[world, box, 2, 1])
        )
        z_axis = _turned(
            eye, (axes[world, box, 0, 2], axes[world, box, 1, 2], axes[world, box, 2, 2])
        )
        half, color = triple(halves, world, box), triple(colors, world, box)
        draw_box(picture, center, x_axis, y_axis, z_axis, half, color, lens, light)
    _draw_robot(picture, robot, worlds, world, eye, lens, light, frames)


@kernel(counts=False)
def _draw_robot(
    picture: Canvas,
    robot: RobotArrays,
    worlds: WorldArrays,
    world: int,
    eye: Eye,
    lens: Lens,
    light: Light,
    frames: Floats,
) -> None:
    """Draws a world's robot; `frames` (L, 3, 4) is room for its links."""
    move_links(
        robot.parents, robot.joints, robot.origins, robot.axes, worlds.joints, world, 0, frames
    )
    links, poses, sizes, paints = (
        robot.shape_links,
        robot.shape_poses,
        robot.shape_half,
        robot.shape_colors,
    )
    for shape in range(len(links)):
        link = links[shape]
        point = in_world(frames, link, poses[shape, 0, 3], poses[shape, 1, 3], poses[shape, 2, 3])
        center = _placed(eye, point)
        if not in_sight(center, robot.shape_radius[shape], lens):
            continue
        x_axis = _turned(eye, column_in_world(frames, link, poses, shape, 0))
        y_axis = _turned(eye, column_in_world(frames, link, poses, shape, 1))
        z_axis = _turned(eye, column_in_world(frames, link, poses, shape, 2))
        half = (sizes[shape, 0], sizes[shape, 1], sizes[shape, 2])
        color = (paints[shape, 0], paints[shape, 1], paints[shape, 2])
        if robot.is_cylinder[shape]:
            draw_cylinder(picture, center, x_axis, y_axis, z_axis, half, color, lens, light)
        else:
            draw_box(picture, center, x_axis, y_axis, z_axis, half, color, lens, light)


@kernel(counts=False)
def _turned(eye: Eye, direction: Vector) -> Vector:
    """A direction of the world in the axes of a camera."""
    return dot(eye.right, direction), dot(eye.down, direction), dot(eye.forward, direction)


@kernel(counts=False)
def _placed(eye: Eye, point: Vector) -> Vector:
    """A point of the world in the axes of a camera."""
    return _turned(eye, minus(point, eye.position))
