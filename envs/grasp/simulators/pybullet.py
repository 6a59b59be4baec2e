"""PyBullet as the simulator: its collision detection, and TinyRenderer's pictures."""

from __future__ import annotations

import ctypes
import math
import os
import sys
import time
from dataclasses import dataclass

import numpy as np
import pybullet
from numpy.typing import NDArray

from encoders.spaces import DepthImage
from envs.grasp.camera import Views, focal_length_px, sense_depth
from envs.grasp.robot import KR16_URDF
from envs.grasp.scene import Scenes
from envs.grasp.settings import Camera, Support
from envs.grasp.simulators.base import Contacts, Floats, Images, Indices
from envs.grasp.simulators.colors import BLOCK_RGBA, SUPPORT_RGBA

# A client costs 30 MB whatever it holds, so worlds share them; but every block that is parked while
# another world has its turn costs some microseconds of each picture.
CLIENTS_PER_PROCESS = 8
# PyBullet keeps some 10 kB of every removed body until its whole simulation is reset.
LOADS_BEFORE_RESET = 400
PARKED_M = [0.0, 0.0, -1000.0]
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
WINDOW_POSE_S = 0.04


class PyBulletSimulator:
    """N worlds in this process. Implements `envs.grasp.simulators.base.Simulator`.

    Args:
        num_worlds: N.
        support: the table.
        window: show the worlds of the first client in PyBullet's window, at a pace to be watched.
    """

    def __init__(self, num_worlds: int, support: Support, window: bool = False):
        self._worlds_per_client = math.ceil(num_worlds / CLIENTS_PER_PROCESS)
        count = math.ceil(num_worlds / self._worlds_per_client)
        self._clients = [_Client(support, window and number == 0) for number in range(count)]

    def load(self, indices: Indices, scenes: Scenes, joints_rad: Floats) -> None:
        """See `Simulator.load`."""
        for row, index in enumerate(indices):
            client, slot = self._place(index)
            client.load(slot, scenes[row : row + 1], joints_rad[row])

    def move(self, indices: Indices, path_rad: Floats) -> Contacts:
        """See `Simulator.move`."""
        flags = np.zeros((len(indices), 2), bool)
        for row, index in enumerate(indices):
            client, slot = self._place(index)
            flags[row] = client.move(slot, path_rad[row])
        return Contacts(touched=flags[:, 0], collided=flags[:, 1])

    def render(self, indices: Indices, views: Views) -> Images:
        """See `Simulator.render`."""
        camera, matrices = (
            views.camera,
            zip(view_matrices(views), projection_matrices(views), strict=True),
        )
        images = []
        for index, (view, projection) in zip(indices, matrices, strict=True):
            client, slot = self._place(index)
            images.append(client.render(slot, camera, view, projection))
        if camera.type == "rgb":
            return np.stack([rgb for rgb, _ in images])
        return buffer_to_depth(np.stack([buffer for _, buffer in images]), views)

    def sense(
        self, indices: Indices, views: Views, space: DepthImage, seeds: NDArray[np.uint64]
    ) -> Images:
        """See `Simulator.sense`."""
        return sense_depth(self.render(indices, views), space, views.noise_sigma_m, seeds)

    def close(self) -> None:
        """See `Simulator.close`."""
        while self._clients:
            self._clients.pop().close()

    def _place(self, index: int) -> tuple[_Client, int]:
        client, slot = divmod(int(index), self._worlds_per_client)
        return self._clients[client], slot


@dataclass
class _World:
    """What one client remembers of one of its worlds."""

    scene: Scenes
    joints_rad: Floats
    blocks: list[int]
    poses: list[tuple[list[float], list[float]]]


class _Client:
    """One physics server. Its worlds share the robot and the support, and take turns.

    The blocks of the worlds that wait are parked out of sight. Contacts are asked for pair by pair
    (`getClosestPoints`), which keeps nothing from one question to the next, so that a run which is
    resumed sees what an uninterrupted one sees.
    """

    def __init__(self, support: Support, window: bool):
        self._support = support
        if window:
            _require_display()
        self._pause_s = WINDOW_POSE_S if window else 0.0
        self._id = pybullet.connect(pybullet.GUI if window else pybullet.DIRECT)
        if window:
            pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=self._id)
            pybullet.resetDebugVisualizerCamera(
                1.6, 50.0, -30.0, (0.9, 0.0, 0.7), physicsClientId=self._id
            )
        self._worlds: dict[int, _World] = {}
        self._active: int | None = None
        self._loads = 0
        self._build()

    def load(self, slot: int, scene: Scenes, joints_rad: Floats) -> None:
        if slot in self._worlds:
            for body in self._worlds[slot].blocks:
                pybullet.removeBody(body, physicsClientId=self._id)
        positions, yaws = scene.block_position_m[0].tolist(), scene.block_yaw_rad[0].tolist()
        poses = [(position, _turned(yaw)) for position, yaw in zip(positions, yaws, strict=True)]
        self._worlds[slot] = _World(scene, joints_rad, [], poses)
        self._active = None if self._active == slot else self._active
        self._loads += 1
        if self._loads % LOADS_BEFORE_RESET == 0:
            pybullet.resetSimulation(physicsClientId=self._id)
            self._build()
        else:
            self._add_blocks(self._worlds[slot])

    def move(self, slot: int, path_rad: Floats) -> tuple[bool, bool]:
        """Moves along joint poses (p, 6); returns whether it touched, and whether it collided."""
        self._activate(slot)
        world = self._worlds[slot]
        touched = collided = False
        for joints_rad in path_rad:
            self._set_joints(joints_rad)
            for number, body in enumerate((*world.blocks, self._table)):
                for link in self._touching_links(body):
                    if link == self._cup and number == 0:
                        touched = True
                    else:
                        collided = True
            if self._pause_s:
                time.sleep(self._pause_s)
        world.joints_rad = path_rad[-1]
        return touched, collided

    def render(
        self, slot: int, camera: Camera, view: list[float], projection: list[float]
    ) -> tuple[Images, Images]:
        """RGB (H, W, 3) and OpenGL's depth buffer (H, W) of one world."""
        self._activate(slot)
        scene = self._worlds[slot].scene
        intensity = float(scene.light_intensity[0])
        size = (camera.height, camera.width)
        _, _, rgba, buffer, _ = pybullet.getCameraImage(
            camera.width,
            camera.height,
            view,
            projection,
            lightDirection=scene.light_direction[0].tolist(),
            lightAmbientCoeff=1.0 - intensity,
            lightDiffuseCoeff=intensity,
            lightSpecularCoeff=0.0,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._id,
        )
        return np.reshape(rgba, (*size, 4))[..., :3], np.reshape(buffer, size)

    def close(self) -> None:
        if pybullet.isConnected(self._id):
            pybullet.disconnect(self._id)

    def _build(self) -> None:
        """Puts everything into an empty simulation."""
        self._active = None
        self._robot = pybullet.loadURDF(
            str(KR16_URDF),
            useFixedBase=True,
            flags=pybullet.URDF_USE_IMPLICIT_CYLINDER,  # a hull would dent the cup's rim
            physicsClientId=self._id,
        )
        infos = [
            pybullet.getJointInfo(self._robot, number, physicsClientId=self._id)
            for number in range(pybullet.getNumJoints(self._robot, physicsClientId=self._id))
        ]
        self._joints = [info[0] for info in infos if info[2] == pybullet.JOINT_REVOLUTE]
        self._cup = next(info[0] for info in infos if info[12] == b"cup")
        (x_low, x_high), (y_low, y_high) = self._support.x_m, self._support.y_m
        low = np.array([x_low, y_low, self._support.top_m - self._support.thickness_m])
        high = np.array([x_high, y_high, self._support.top_m])
        self._table = self._add_boxes(np.zeros((1, 3)), (high - low)[None] / 2, SUPPORT_RGBA)
        self._put(self._table, ((low + high) / 2).tolist(), UPRIGHT)
        for world in self._worlds.values():
            self._add_blocks(world)

    def _add_blocks(self, world: _World) -> None:
        """Adds a world's blocks, parked."""
        scene = world.scene
        world.blocks = []
        for number in range(scene.box_half_m.shape[1]):
            used = scene.box_half_m[0, number, :, 0] > 0.0
            center, half = scene.box_center_m[0, number, used], scene.box_half_m[0, number, used]
            color = BLOCK_RGBA[number % len(BLOCK_RGBA)]
            world.blocks.append(self._add_boxes(center, half, color))
            self._put(world.blocks[-1], PARKED_M, UPRIGHT)

    def _add_boxes(self, center_m: Floats, half_m: Floats, rgba: tuple[float, ...]) -> int:
        """Adds one fixed body made of boxes (k, 3)."""
        count, centers, halves = len(half_m), center_m.tolist(), half_m.tolist()
        collision = pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * count,
            halfExtents=halves,
            collisionFramePositions=centers,
            physicsClientId=self._id,
        )
        visual = pybullet.createVisualShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * count,
            halfExtents=halves,
            visualFramePositions=centers,
            rgbaColors=[rgba] * count,
            physicsClientId=self._id,
        )
        body: int = pybullet.createMultiBody(0.0, collision, visual, physicsClientId=self._id)
        return body

    def _activate(self, slot: int) -> None:
        """Parks the blocks of the world before, and puts this one's in place."""
        if slot == self._active:
            return
        if self._active is not None:
            for body in self._worlds[self._active].blocks:
                self._put(body, PARKED_M, UPRIGHT)
        world = self._worlds[slot]
        for body, (position_m, orientation) in zip(world.blocks, world.poses, strict=True):
            self._put(body, position_m, orientation)
        self._set_joints(world.joints_rad)
        self._active = slot

    def _put(self, body: int, position_m: list[float], orientation: list[float]) -> None:
        pybullet.resetBasePositionAndOrientation(
            body, position_m, orientation, physicsClientId=self._id
        )

    def _set_joints(self, joints_rad: Floats) -> None:
        pybullet.resetJointStatesMultiDof(
            self._robot,
            self._joints,
            [[angle] for angle in joints_rad.tolist()],
            physicsClientId=self._id,
        )

    def _touching_links(self, body: int) -> list[int]:
        """Links of the robot that touch or enter a body."""
        points = pybullet.getClosestPoints(
            self._robot, body, distance=0.0, physicsClientId=self._id
        )
        return [point[3] for point in points]


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


def _turned(yaw_rad: float) -> list[float]:
    """The quaternion (x, y, z, w) of a turn about the vertical."""
    return [0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)]


def view_matrices(views: Views) -> list[list[float]]:
    """OpenGL's view matrices of n views, each column by column."""
    # OpenGL's camera axes are x right, y up, z backward.
    axes = np.swapaxes(views.rotation, 1, 2) * np.array([[1.0], [-1.0], [-1.0]])
    matrices = np.tile(np.eye(4), (len(views), 1, 1))
    matrices[:, :3, :3] = axes
    matrices[:, :3, 3] = -np.einsum("nij,nj->ni", axes, views.position_m)
    return _columns(matrices)


def projection_matrices(views: Views) -> list[list[float]]:
    """OpenGL's projection matrices of n views, each column by column.

    TinyRenderer samples pixel (c, r) at the image point (c, r + 1), not at the pixel's centre; the
    picture is shifted by half a pixel each way to make up for it.
    """
    camera, focal = views.camera, focal_length_px(views.camera)
    near, far = views.near_m, views.far_m
    matrices = np.zeros((len(views), 4, 4))
    matrices[:, 0, 0], matrices[:, 0, 2] = 2 * focal / camera.width, 1.0 / camera.width
    matrices[:, 1, 1], matrices[:, 1, 2] = 2 * focal / camera.height, 1.0 / camera.height
    matrices[:, 2, 2], matrices[:, 2, 3] = (
        -(far + near) / (far - near),
        -2 * far * near / (far - near),
    )
    matrices[:, 3, 2] = -1.0
    return _columns(matrices)


def _columns(matrices: Floats) -> list[list[float]]:
    columns: list[list[float]] = np.swapaxes(matrices, 1, 2).reshape(-1, 16).tolist()
    return columns


def buffer_to_depth(buffer: Images, views: Views) -> Images:
    """Metres (n, H, W) from OpenGL's depth buffers in [0, 1]; infinite where nothing was drawn."""
    near = views.near_m.astype(np.float32)[:, None, None]
    far = views.far_m.astype(np.float32)[:, None, None]
    depth = far * near / (far - (far - near) * buffer)
    # What was never written comes back as the far plane, but for rounding.
    depth[depth >= far * (1.0 - 1e-4)] = np.inf
    return depth
