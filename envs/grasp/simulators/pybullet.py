"""PyBullet as the simulator: its collision detection, and TinyRenderer's pictures."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import DepthImage
from envs.grasp.robot.kinematics import shape_reach
from envs.grasp.robot.paths import Path, leg_poses, leg_speeds, legs
from envs.grasp.robot.urdf import Robot
from envs.grasp.scene import surroundings
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses, sampling
from envs.grasp.sensors.depth import sense_depth
from envs.grasp.settings import Camera, Support, check_resolution
from envs.grasp.simulators.base import Contacts, Floats, Images, Indices
from envs.grasp.simulators.bodies import (
    UPRIGHT,
    add_around,
    add_boxes,
    add_robot,
    add_support,
    block_boxes,
    close_client,
    open_client,
    put,
    set_joints,
    take_picture,
    turned,
)
from envs.grasp.simulators.bullet import pybullet
from envs.grasp.simulators.colors import BLOCK_RGBA

# A client costs 30 MB whatever it holds, so worlds share them; but every block that is parked while
# another world has its turn costs some microseconds of each picture.
CLIENTS_PER_PROCESS = 8
# PyBullet keeps some 10 kB of every removed body until its whole simulation is reset.
LOADS_BEFORE_RESET = 400
PARKED_M, ORIGIN_M = [0.0, 0.0, -1000.0], [0.0, 0.0, 0.0]
# Of the window: how long a pose is shown, and how far the robot moves, at most, to the next.
WINDOW_POSE_S, WINDOW_POSE_M = 0.04, 0.02
# Distances are asked for up to this: PyBullet takes longer the more it has to measure.
SIGHT_M = 0.1


class PyBulletSimulator:
    """N worlds in this process. Implements `envs.grasp.simulators.base.Simulator`.

    Args:
        num_worlds: N.
        robot: stands in every one of them.
        support: the table.
        window: show the worlds of the first client in PyBullet's window, at a pace to be watched.
    """

    def __init__(self, num_worlds: int, robot: Robot, support: Support, window: bool = False):
        self._worlds_per_client = math.ceil(num_worlds / CLIENTS_PER_PROCESS)
        count = math.ceil(num_worlds / self._worlds_per_client)
        self._clients = [_Client(robot, support, window and number == 0) for number in range(count)]

    def load(self, indices: Indices, scenes: Scenes, joints_rad: Floats) -> None:
        """See `Simulator.load`."""
        for row, index in enumerate(indices):
            client, slot = self._place(index)
            client.load(slot, scenes[row : row + 1], joints_rad[row])

    def move(self, indices: Indices, path_rad: Path, resolution_m: float) -> Contacts:
        """See `Simulator.move`."""
        check_resolution(resolution_m)
        flags = np.zeros((len(indices), 2), bool)
        for row, index in enumerate(indices):
            client, slot = self._place(index)
            flags[row] = client.move(slot, path_rad[row], resolution_m)
        return Contacts(touched=flags[:, 0], collided=flags[:, 1])

    def render(self, indices: Indices, views: CameraPoses) -> Images:
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

    def render_depth(
        self, indices: Indices, views: CameraPoses, space: DepthImage, seeds: NDArray[np.uint64]
    ) -> Images:
        """See `Simulator.render_depth`."""
        return sense_depth(self.render(indices, views), views, space, seeds)

    def close(self) -> None:
        """See `Simulator.close`."""
        while self._clients:
            self._clients.pop().close()

    def _place(self, index: int) -> tuple[_Client, int]:
        client, slot = divmod(int(index), self._worlds_per_client)
        return self._clients[client], slot


@dataclass
class _Found:
    """Contacts found so far."""

    touched: bool = False
    collided: bool = False

    @property
    def all(self) -> bool:
        """Whether there is nothing more to be found."""
        return self.touched and self.collided

    def add(self, *, on_target: bool) -> None:
        """Takes down a contact: the cup's with the target, or another."""
        self.touched |= on_target
        self.collided |= not on_target


@dataclass
class _World:
    """State of one of a client's worlds.

    Its bodies are the blocks, then what stands around; each has its pose. The untouchable ones are
    seen, and can't be touched.
    """

    scene: Scenes
    joints_rad: Floats
    poses: list[tuple[list[float], list[float]]]
    solid: list[int] = field(default_factory=list)
    untouchable: list[int] = field(default_factory=list)

    @property
    def bodies(self) -> list[int]:
        """All of them."""
        return self.solid + self.untouchable

    def place(self, number: int) -> tuple[list[float], list[float]]:
        """Where one of the bodies is put: what stands around is built where it stands."""
        return self.poses[number] if number < len(self.poses) else (ORIGIN_M, UPRIGHT)


class _Client:
    """One physics server. Its worlds share the robot and the support, and take turns.

    The bodies of the worlds that wait are parked out of sight. Contacts are asked for pair by pair
    (`getClosestPoints`), which keeps nothing from one question to the next, so that a run which is
    resumed sees what an uninterrupted one sees.
    """

    def __init__(self, robot: Robot, support: Support, window: bool):
        self._kinematics, self._support = robot, support
        self._reach_m = np.max(shape_reach(robot), axis=0)
        self._window = window
        self._id = open_client(window)
        self._worlds: dict[int, _World] = {}
        self._active: int | None = None
        self._loads = 0
        self._build()

    def load(self, slot: int, scene: Scenes, joints_rad: Floats) -> None:
        if slot in self._worlds:
            for body in self._worlds[slot].bodies:
                pybullet.removeBody(body, physicsClientId=self._id)
        positions, yaws = scene.block_position_m[0].tolist(), scene.block_yaw_rad[0].tolist()
        poses = [(position, turned(yaw)) for position, yaw in zip(positions, yaws, strict=True)]
        self._worlds[slot] = _World(scene, joints_rad, poses)
        self._active = None if self._active == slot else self._active
        self._loads += 1
        if self._loads % LOADS_BEFORE_RESET == 0:
            pybullet.resetSimulation(physicsClientId=self._id)
            self._build()
        else:
            self._add_bodies(self._worlds[slot])

    def move(self, slot: int, path_rad: Path, resolution_m: float) -> tuple[bool, bool]:
        """Moves along a path (2 k + 1, 6); returns whether it touched, and whether it collided."""
        self._activate(slot)
        found = _Found()
        for leg in legs(path_rad):
            # No point of the robot moves further than this on the leg.
            way_m = float(leg_speeds(leg) @ self._reach_m)
            part = 0.0
            while part < 1.0 and way_m > 0.0 and not found.all:
                joints_rad = leg_poses(leg, np.array([part]))[0]
                clear_m = self._look(self._worlds[slot], joints_rad, found)
                part += max(clear_m, resolution_m) / way_m
        self._look(self._worlds[slot], path_rad[-1], found)
        if self._window:
            self._show(path_rad)
        self._worlds[slot].joints_rad = path_rad[-1]
        return found.touched, found.collided

    def render(
        self, slot: int, camera: Camera, view: list[float], projection: list[float]
    ) -> tuple[Images, Images]:
        """RGB (H, W, 3) and OpenGL's depth buffer (H, W) of one world."""
        self._activate(slot)
        return take_picture(self._id, self._worlds[slot].scene, camera, view, projection)

    def close(self) -> None:
        close_client(self._id)

    def _build(self) -> None:
        """Puts everything into an empty simulation."""
        self._active = None
        self._robot = add_robot(self._id, self._kinematics)
        self._table = add_support(self._id, self._support)
        for world in self._worlds.values():
            self._add_bodies(world)

    def _add_bodies(self, world: _World) -> None:
        """Adds a world's bodies, parked."""
        scene = world.scene
        blocks = [
            add_boxes(self._id, *block_boxes(scene, number), BLOCK_RGBA[number % len(BLOCK_RGBA)])
            for number in range(scene.box_half_m.shape[1])
        ]
        solid, untouchable = (
            [add_around(self._id, scene, part) for part in parts]
            for parts in (surroundings.SOLID, (surroundings.FLOOR,))
        )
        world.solid = blocks + [body for body in solid if body is not None]
        world.untouchable = [body for body in untouchable if body is not None]
        for body in world.bodies:
            put(self._id, body, PARKED_M, UPRIGHT)

    def _activate(self, slot: int) -> None:
        """Parks the bodies of the world before, and puts this one's in place."""
        if slot == self._active:
            return
        if self._active is not None:
            for body in self._worlds[self._active].bodies:
                put(self._id, body, PARKED_M, UPRIGHT)
        world = self._worlds[slot]
        for number, body in enumerate(world.bodies):
            put(self._id, body, *world.place(number))
        set_joints(self._id, self._robot, world.joints_rad)
        self._active = slot

    def _show(self, path_rad: Path) -> None:
        """Moves along a path (2 k + 1, 6) at a pace to be watched."""
        for leg in legs(path_rad):
            poses = math.ceil(float(leg_speeds(leg) @ self._reach_m) / WINDOW_POSE_M)
            for joints_rad in leg_poses(leg, np.linspace(0.0, 1.0, poses + 1)[1:]):
                set_joints(self._id, self._robot, joints_rad)
                time.sleep(WINDOW_POSE_S)

    def _look(self, world: _World, joints_rad: Floats, found: _Found) -> float:
        """Puts the robot somewhere, and adds what it touches there to what was found.

        Returns:
            The distance in metres to what it does not touch yet, `SIGHT_M` at most.
        """
        set_joints(self._id, self._robot, joints_rad)
        clear_m = SIGHT_M
        for number, body in enumerate((*world.solid, self._table)):
            for point in pybullet.getClosestPoints(
                self._robot.body, body, distance=SIGHT_M, physicsClientId=self._id
            ):
                link, distance_m = point[3], point[8]
                on_target = link == self._robot.cup and number == 0
                if distance_m <= 0.0:
                    found.add(on_target=on_target)
                elif not (found.touched if on_target else found.collided):
                    clear_m = min(clear_m, distance_m)
        return clear_m


def view_matrices(views: CameraPoses) -> list[list[float]]:
    """OpenGL's view matrices of n views, each column by column."""
    # OpenGL's camera axes are x right, y up, z backward.
    axes = np.swapaxes(views.rotation, 1, 2) * np.array([[1.0], [-1.0], [-1.0]])
    matrices = np.tile(np.eye(4), (len(views), 1, 1))
    matrices[:, :3, :3] = axes
    matrices[:, :3, 3] = -np.einsum("nij,nj->ni", axes, views.position_m)
    return _columns(matrices)


def projection_matrices(views: CameraPoses) -> list[list[float]]:
    """OpenGL's projection matrices of n views, each column by column.

    TinyRenderer samples pixel (c, r) at the image point (c, r + 1), not at the pixel's centre; the
    picture is shifted by half a pixel each way to make up for it.
    """
    taken = sampling(views.camera)
    width, height = taken.width, taken.height
    fx, fy, cx, cy = views.intrinsics.T
    near, far = views.near_m, views.far_m
    matrices = np.zeros((len(views), 4, 4))
    matrices[:, 0, 0], matrices[:, 0, 2] = 2 * fx / width, (width - 2 * cx + 1.0) / width
    matrices[:, 1, 1], matrices[:, 1, 2] = 2 * fy / height, (2 * cy - height + 1.0) / height
    matrices[:, 2, 2], matrices[:, 2, 3] = (
        -(far + near) / (far - near),
        -2 * far * near / (far - near),
    )
    matrices[:, 3, 2] = -1.0
    return _columns(matrices)


def _columns(matrices: Floats) -> list[list[float]]:
    columns: list[list[float]] = np.swapaxes(matrices, 1, 2).reshape(-1, 16).tolist()
    return columns


def buffer_to_depth(buffer: Images, views: CameraPoses) -> Images:
    """Metres (n, H, W) from OpenGL's depth buffers in [0, 1]; infinite where nothing was drawn."""
    near = views.near_m.astype(np.float32)[:, None, None]
    far = views.far_m.astype(np.float32)[:, None, None]
    depth = far * near / (far - (far - near) * buffer)
    # What was never written comes back as the far plane, but for rounding.
    depth[depth >= far * (1.0 - 1e-4)] = np.inf
    return depth
