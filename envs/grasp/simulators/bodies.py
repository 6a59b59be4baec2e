"""Parts of PyBullet's worlds: client, robot, support, bodies of boxes, and pictures."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from dataclasses import dataclass

import numpy as np

from envs.grasp.robot.urdf import Robot
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import sampling
from envs.grasp.settings import Camera, Support
from envs.grasp.simulators.base import Floats, Images
from envs.grasp.simulators.bullet import pybullet
from envs.grasp.simulators.colors import AROUND_RGBA, SUPPORT_RGBA

Rgba = tuple[float, float, float, float]
UPRIGHT = [0.0, 0.0, 0.0, 1.0]


@dataclass(frozen=True)
class RobotBody:
    """The robot in a client: its body, and the numbers of its moving joints and of two links."""

    body: int
    joints: list[int]
    cup: int
    tooltip: int


def open_client(window: bool) -> int:
    """Starts a physics server.

    Raises:
        ValueError: a window is asked for where none can be opened.
    """
    if not window:
        return int(pybullet.connect(pybullet.DIRECT))
    _require_display()
    client = int(pybullet.connect(pybullet.GUI))
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    pybullet.resetDebugVisualizerCamera(1.6, 50.0, -30.0, (0.9, 0.0, 0.7), physicsClientId=client)
    return client


def close_client(client: int) -> None:
    """Ends a physics server; calling it twice does no harm."""
    if pybullet.isConnected(client):
        pybullet.disconnect(client)


def add_robot(client: int, robot: Robot) -> RobotBody:
    """Adds a robot, its base fixed to the world's origin."""
    body = pybullet.loadURDF(
        str(robot.path),
        useFixedBase=True,
        flags=pybullet.URDF_USE_IMPLICIT_CYLINDER,  # a hull would dent the cup's rim
        physicsClientId=client,
    )
    infos = [
        pybullet.getJointInfo(body, number, physicsClientId=client)
        for number in range(pybullet.getNumJoints(body, physicsClientId=client))
    ]
    links = {info[12].decode(): info[0] for info in infos}
    joints = [info[0] for info in infos if info[2] == pybullet.JOINT_REVOLUTE]
    cup, tooltip = (links[robot.link_names[link]] for link in (robot.cup_link, robot.tooltip_link))
    return RobotBody(body, joints, cup, tooltip)


def set_joints(client: int, robot: RobotBody, joints_rad: Floats) -> None:
    """Puts the robot's joints (6,) somewhere at once, at rest."""
    pybullet.resetJointStatesMultiDof(
        robot.body,
        robot.joints,
        [[angle] for angle in joints_rad.tolist()],
        physicsClientId=client,
    )


def add_support(client: int, support: Support) -> int:
    """Adds the table, which never moves."""
    (x_low, x_high), (y_low, y_high) = support.x_m, support.y_m
    low = np.array([x_low, y_low, support.top_m - support.thickness_m])
    high = np.array([x_high, y_high, support.top_m])
    table = add_boxes(client, np.zeros((1, 3)), (high - low)[None] / 2, SUPPORT_RGBA)
    put(client, table, ((low + high) / 2).tolist(), UPRIGHT)
    return table


def add_boxes(
    client: int,
    center_m: Floats,
    half_m: Floats,
    rgba: Rgba | list[Rgba],
    mass_kg: float = 0.0,
    orientations: list[list[float]] | None = None,
) -> int:
    """Adds one body made of boxes (k, 3), 16 at most; with a mass of 0 it never moves.

    Its centre of mass is the origin of its frame. Colors and orientations are those of each box, or
    one color of all, and none is turned.
    """
    count, centers, halves = len(half_m), center_m.tolist(), half_m.tolist()
    turns = orientations or [UPRIGHT] * count
    collision = pybullet.createCollisionShapeArray(
        shapeTypes=[pybullet.GEOM_BOX] * count,
        halfExtents=halves,
        collisionFramePositions=centers,
        collisionFrameOrientations=turns,
        physicsClientId=client,
    )
    visual = pybullet.createVisualShapeArray(
        shapeTypes=[pybullet.GEOM_BOX] * count,
        halfExtents=halves,
        visualFramePositions=centers,
        visualFrameOrientations=turns,
        rgbaColors=rgba if isinstance(rgba, list) else [rgba] * count,
        physicsClientId=client,
    )
    body: int = pybullet.createMultiBody(mass_kg, collision, visual, physicsClientId=client)
    return body


def add_around(client: int, scene: Scenes, part: slice) -> int | None:
    """Adds a part of what stands around in the first scene, where it stands; None if it is empty.

    It is one body, which never moves.
    """
    used = part.start + np.flatnonzero(scene.around_half_m[0, part, 0] > 0.0)
    if not len(used):
        return None
    return add_boxes(
        client,
        scene.around_center_m[0, used],
        scene.around_half_m[0, used],
        [AROUND_RGBA[box] for box in used],
        orientations=[quaternion(turn) for turn in scene.around_rotation[0, used]],
    )


def put(client: int, body: int, position_m: list[float], orientation: list[float]) -> None:
    """Puts a body somewhere at once."""
    pybullet.resetBasePositionAndOrientation(body, position_m, orientation, physicsClientId=client)


def block_boxes(scene: Scenes, number: int) -> tuple[Floats, Floats]:
    """Centres and half extents (k, 3) of the boxes that a block of the first scene has."""
    used = scene.box_half_m[0, number, :, 0] > 0.0
    return scene.box_center_m[0, number, used], scene.box_half_m[0, number, used]


def turned(yaw_rad: float) -> list[float]:
    """The quaternion (x, y, z, w) of a turn about the vertical."""
    return [0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)]


def quaternion(rotation: Floats) -> list[float]:
    """The quaternion (x, y, z, w) of a rotation (3, 3).

    It is the eigenvector to the largest eigenvalue of a matrix whose entries are sums of the
    rotation's. Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix",
    Journal of Guidance, Control, and Dynamics 23(6), 2000.
    """
    skew = rotation.T - rotation
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = rotation + rotation.T - np.trace(rotation) * np.eye(3)
    matrix[3, :3] = matrix[:3, 3] = skew[1, 2], skew[2, 0], skew[0, 1]
    matrix[3, 3] = np.trace(rotation)
    values, vectors = np.linalg.eigh(matrix)
    found: list[float] = vectors[:, np.argmax(values)].tolist()
    return found


def take_picture(
    client: int, scene: Scenes, camera: Camera, view: list[float], projection: list[float]
) -> tuple[Images, Images]:
    """RGB (H, W, 3) and OpenGL's depth buffer (H, W), in the light of the first scene."""
    intensity = float(scene.light_intensity[0])
    taken = sampling(camera)
    _, _, rgba, buffer, _ = pybullet.getCameraImage(
        taken.width,
        taken.height,
        view,
        projection,
        lightDirection=scene.light_direction[0].tolist(),
        lightAmbientCoeff=1.0 - intensity,
        lightDiffuseCoeff=intensity,
        lightSpecularCoeff=0.0,
        shadow=0,
        renderer=pybullet.ER_TINY_RENDERER,
        flags=pybullet.ER_NO_SEGMENTATION_MASK,
        physicsClientId=client,
    )
    size = (taken.height, taken.width)
    return np.reshape(rgba, (*size, 4))[..., :3], np.reshape(buffer, size)


def _require_display() -> None:
    """Asks for the display before PyBullet does, which ends the whole process without one.

    Raises:
        ValueError: there is no X server at `DISPLAY`.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as error:
        raise ValueError(f"no window can be opened without the library libX11: {error}") from error
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if not display:
        where = os.environ.get("DISPLAY")
        raise ValueError(
            f"no window can be opened: {f'DISPLAY={where}' if where else 'DISPLAY is not set and'} "
            "leads to no X server; set it to one that runs, or use render_mode: rgb_array"
        )
    x11.XCloseDisplay(ctypes.c_void_p(display))
