"""The physical pick: what becomes of a commanded tool pose in a world with gravity and friction.

Training judges a pose by geometry alone. Here the robot drives there with motors, advances its cup
to contact, and sucks and lifts a block that has a mass and stands among others that can fall over.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from enum import Enum, auto
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.evaluation.outcome import Outcome
from envs.grasp.evaluation.pose_commands import PoseCommands
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.kinematics import InverseKinematics, tooltip_pose
from envs.grasp.robot.paths import Path, leg_speeds, legs, path_poses, straight_leg
from envs.grasp.scene.sampler import Scenes, to_world
from envs.grasp.scene.surroundings import FLOOR, SOLID
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.settings import Pick, Support
from envs.grasp.simulators.base import Floats, Images
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
from envs.grasp.simulators.pybullet import projection_matrices, view_matrices

RIM_POINTS = 72
STEP_S = 1.0 / 240.0
GRAVITY_M_S2 = 9.81
MOTOR_NM = 2000.0
MOTOR_GAIN = 0.8
# The smooth motion 3 t^2 - 2 t^3 is so much faster in its middle than in the mean.
SMOOTH_PEAK = 1.5
# What a lift may lack: the block hangs a little lower than it stood, as it does on a real cup.
LIFT_SLACK_M = 0.01


class Touch(Enum):
    """Contact of the robot, the worst of those it has."""

    NOTHING = auto()
    CUP_ON_TARGET = auto()
    OTHER = auto()


Transform = tuple[tuple[float, ...], tuple[float, ...]]
"""PyBullet's: position (x, y, z) and quaternion (x, y, z, w)."""
Watch = Callable[["Attempt"], None]


def unwatched(_: Attempt) -> None:
    """Looks away."""


class Picker:
    """Carries out picks, one after the other. They are deterministic, whatever came before them.

    Args:
        arm: picks.
        support: the table.
        settings: masses, frictions, forces and ways.
        window: show the picks in PyBullet's window, as fast as they would go.

    Raises:
        ValueError: a window is asked for where none can be opened.
    """

    def __init__(self, arm: Arm, support: Support, settings: Pick, window: bool = False):
        self._arm, self._support, self._settings = arm, support, settings
        self._window = window
        self._client = open_client(window)

    def pick(
        self, scene: Scenes, tooltip_m: Floats, yaw_rad: float, watch: Watch = unwatched
    ) -> Outcome:
        """Picks the target of one scene from a commanded pose.

        Args:
            scene: one row.
            tooltip_m: (3,) where the centre of the cup's face is sent, world frame.
            yaw_rad: the tool's yaw there.
            watch: called after every time step.
        """
        attempt = self._attempt(scene, watch)
        if attempt.reach(tooltip_m, yaw_rad) is not Touch.NOTHING:
            return Outcome.COLLISION
        touch = attempt.advance()
        if touch is not Touch.CUP_ON_TARGET:
            return Outcome.MISSED if touch is Touch.NOTHING else Outcome.COLLISION
        if not attempt.seals():
            return Outcome.NO_SEAL
        return Outcome.SUCCESS if attempt.lift() else Outcome.DROPPED

    def reach(
        self, scene: Scenes, tooltip_m: Floats, yaw_rad: float, watch: Watch = unwatched
    ) -> None:
        """Only drives to the commanded pose, or to the first contact; see `pick`."""
        self._attempt(scene, watch).reach(tooltip_m, yaw_rad)

    def close(self) -> None:
        """Ends the simulation; calling it twice does no harm."""
        close_client(self._client)

    def _attempt(self, scene: Scenes, watch: Watch) -> Attempt:
        def at_its_pace(attempt: Attempt) -> None:
            watch(attempt)
            time.sleep(STEP_S)

        shown = at_its_pace if self._window else watch
        return Attempt(self._client, self._arm, self._support, self._settings, scene, shown)


class PickCheck:
    """Picks at the commands of actions. Implements `envs.evaluation.PhysicalCheck`.

    Args:
        picker: carries them out; it is closed with this.
        commands: where actions would lead in the running episodes.

    Attributes:
        tried_out: actions that it is through with.
    """

    def __init__(self, picker: Picker, commands: Callable[[NDArray[Any]], PoseCommands]):
        self._picker, self._pose_commands = picker, commands
        self.tried_out = 0

    def __call__(self, actions: NDArray[Any]) -> dict[str, NDArray[np.bool_]]:
        """See `PhysicalCheck`; the names are those of `Outcome`."""
        commands = self._pose_commands(actions)
        outcomes = np.empty(len(commands), object)
        for row, yaw_rad in enumerate(commands.yaw_rad):
            scene, tooltip_m = commands.scenes[row : row + 1], commands.tooltip_m[row]
            outcomes[row] = self._picker.pick(scene, tooltip_m, float(yaw_rad))
            self.tried_out += 1
        return {str(outcome): outcomes == outcome for outcome in Outcome}

    def close(self) -> None:
        """See `PhysicalCheck`."""
        self._picker.close()


class Attempt:
    """One pick in a world built for it, the robot in its home pose.

    Args:
        client: PyBullet's; what it holds is removed.
        arm: picks.
        support: the table.
        settings: masses, frictions, forces and ways.
        scene: one row.
        watch: called after every time step.
    """

    def __init__(
        self,
        client: int,
        arm: Arm,
        support: Support,
        settings: Pick,
        scene: Scenes,
        watch: Watch = unwatched,
    ):
        self._id, self._settings, self._scene, self._watch = client, settings, scene, watch
        self._arm, self._kinematics = arm, arm.robot
        self._inverse = InverseKinematics(arm.robot)
        # No state that a solver keeps of an earlier pick can change this one.
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setGravity(0.0, 0.0, -GRAVITY_M_S2, physicsClientId=client)
        pybullet.setTimeStep(STEP_S, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        self._robot = add_robot(client, arm.robot)
        self._joints_rad = arm.robot.home_rad
        set_joints(client, self._robot, self._joints_rad)
        table = add_support(client, support)
        for part in (*SOLID, FLOOR):
            add_around(client, scene, part)
        blocks = [self._add_block(number) for number in range(scene.box_half_m.shape[1])]
        for body in (table, *blocks):
            pybullet.changeDynamics(
                body, -1, lateralFriction=settings.friction, physicsClientId=client
            )
        self._target = blocks[0]
        self._start_height_m = self.target_pose()[0][2]

    def reach(self, tooltip_m: Floats, yaw_rad: float) -> Touch:
        """Drives from home to a pose as the task does; stops where it touches.

        No joint is faster than it can, and the tool comes to rest at the stand-off.
        """
        home = self._arm.home(1)
        tools, _, _ = self._arm.reach(home, tooltip_m[None], np.array([yaw_rad]))
        ahead = tools.approach_rad[0]
        # From home there is nothing to retreat from.
        transit = straight_leg(self._joints_rad, ahead[0])
        touch = self._drive(transit, 0.0)
        if touch is Touch.NOTHING and (ahead != ahead[0]).any():
            touch = self._drive(ahead, self._settings.approach_s)
        return touch

    def advance(self) -> Touch:
        """Moves the cup ahead from the reached pose until it touches or its way ends.

        It goes along the tool's own axis: where the face's normal points, the robot can't know.
        """
        settings, pose = self._settings, tooltip_pose(self._kinematics, self._joints_rad)
        steps = math.ceil(settings.advance_m / (settings.advance_speed_m_s * STEP_S))
        way_m = np.linspace(0.0, settings.advance_m, steps + 1)[1:]
        return self._follow(self._straight(pose, way_m, pose[:3, 2]))

    def seals(self) -> bool:
        """Whether all of the cup's rim is on the target's face, to within a lip's give."""
        tip, axes = _pose(*self._tooltip())
        position, rotation = _pose(*self.target_pose())
        angle = np.arange(RIM_POINTS)[:, None] * (2.0 * math.pi / RIM_POINTS)
        around = np.cos(angle) * axes[:, 0] + np.sin(angle) * axes[:, 1]
        rim = tip + self._kinematics.cup_radius_m * around
        # In the block's own frame the face is the plane x = 0, a rectangle for each of its boxes.
        local = (rim - position) @ rotation + _center_of_mass(self._scene, 0)
        center, half = block_boxes(self._scene, 0)
        inside = (np.abs(local[:, None, 1:] - center[:, 1:]) <= half[:, 1:]).all(axis=2)
        near = np.abs(local[:, 0]) <= self._settings.seal_m
        return bool((inside.any(axis=1) & near).all())

    def lift(self) -> bool:
        """Sucks, lifts and holds; whether the block came up and is still there."""
        settings = self._settings
        up = settings.lift_m * _smooth(settings.lift_s)
        held = np.full(round(settings.hold_s / STEP_S), settings.lift_m)
        suction, point = self._suck()
        pose = tooltip_pose(self._kinematics, self._joints_rad)
        path = self._straight(pose, np.concatenate([up, held]), np.array([0.0, 0.0, 1.0]))
        for joints_rad in path:
            self._step(joints_rad)
            grasped, _ = pybullet.multiplyTransforms(*self.target_pose(), point, UPRIGHT)
            if math.dist(grasped, self._tooltip()[0]) > settings.seal_m:
                pybullet.removeConstraint(suction, physicsClientId=self._id)
                return False
        return self.target_pose()[0][2] - self._start_height_m >= settings.lift_m - LIFT_SLACK_M

    def target_pose(self) -> Transform:
        """Pose of the target: its centre of mass, and how it is turned."""
        pose: Transform = pybullet.getBasePositionAndOrientation(
            self._target, physicsClientId=self._id
        )
        return pose

    def picture(self, views: CameraPoses) -> Images:
        """Picture (H, W, 3) that an RGB camera, the first of the views, takes now."""
        view, projection = view_matrices(views)[0], projection_matrices(views)[0]
        return take_picture(self._id, self._scene, views.camera, view, projection)[0]

    def _add_block(self, number: int) -> int:
        """Adds a block that can move, where it stands in the scene."""
        center, half = block_boxes(self._scene, number)
        middle = _center_of_mass(self._scene, number)
        mass_kg = self._settings.density_kg_m3 * float(np.prod(2.0 * half, axis=1).sum())
        color = BLOCK_RGBA[number % len(BLOCK_RGBA)]
        body = add_boxes(self._id, center - middle, half, color, mass_kg)
        yaw_rad = self._scene.block_yaw_rad[0, number]
        place_m = to_world(middle[None], self._scene.block_position_m[0, number], yaw_rad)[0]
        put(self._id, body, place_m.tolist(), turned(float(yaw_rad)))
        return body

    def _straight(self, pose: Floats, way_m: Floats, direction: Floats) -> Floats:
        """Joints (k, 6) that move the tool by ways (k,) along a direction (3,) from a pose (4, 4).

        Where a way leads out of reach they are those that come nearest.
        """
        poses = np.tile(pose, (len(way_m), 1, 1))
        poses[:, :3, 3] += way_m[:, None] * direction
        joints_rad, _ = self._inverse.of_pose(poses)
        return np.asarray(joints_rad)

    def _drive(self, path: Path, least_s: float) -> Touch:
        """Drives along a path (2 k + 1, 6), from rest to rest, until something is touched.

        It takes `least_s`, or as long as the slowest joint needs in the middle of it.
        """
        # A path's parts pass evenly: each leg, whatever its length, takes its share of the time.
        speeds = np.array([leg_speeds(leg) for leg in legs(path)]) * len(legs(path))
        needed_s = SMOOTH_PEAK * float(np.max(speeds / self._kinematics.max_speed_rad_s))
        return self._follow(path_poses(path, _smooth(max(needed_s, least_s))))

    def _follow(self, path_rad: Iterable[Floats]) -> Touch:
        """Drives along joints (6,), one after each time step, until something is touched."""
        for joints_rad in path_rad:
            self._step(joints_rad)
            if (touch := self._touch()) is not Touch.NOTHING:
                return touch
        return Touch.NOTHING

    def _step(self, joints_rad: Floats) -> None:
        """Lets a time step pass, in which the motors drive to joints (6,)."""
        speed = (joints_rad - self._joints_rad) / STEP_S
        self._joints_rad = joints_rad
        pybullet.setJointMotorControlArray(
            self._robot.body,
            self._robot.joints,
            pybullet.POSITION_CONTROL,
            targetPositions=joints_rad.tolist(),
            targetVelocities=speed.tolist(),
            positionGains=[MOTOR_GAIN] * len(speed),
            velocityGains=[1.0] * len(speed),
            forces=[MOTOR_NM] * len(speed),
            physicsClientId=self._id,
        )
        pybullet.stepSimulation(physicsClientId=self._id)
        self._watch(self)

    def _touch(self) -> Touch:
        touch = Touch.NOTHING
        points = pybullet.getContactPoints(bodyA=self._robot.body, physicsClientId=self._id)
        for _, _, body, link, _, _, _, _, distance_m, *_ in points:
            if distance_m > 0.0:  # near, but not there yet
                continue
            if (body, link) != (self._target, self._robot.cup):
                return Touch.OTHER
            touch = Touch.CUP_ON_TARGET
        return touch

    def _suck(self) -> tuple[int, tuple[float, ...]]:
        """Fixes the target to the cup; returns by what, and at which point of the target's frame.

        The joint gives way at the force that the cup holds across its axis, friction times vacuum
        times area, in every direction; its moments are not limited.
        """
        settings = self._settings
        area_m2 = math.pi * self._kinematics.cup_radius_m**2
        force_n = settings.cup_friction * settings.vacuum_pa * area_m2
        tooltip = self._tooltip()
        cup = pybullet.getLinkState(self._robot.body, self._robot.cup, physicsClientId=self._id)[:2]
        on_cup = pybullet.multiplyTransforms(*pybullet.invertTransform(*cup), *tooltip)
        on_block = pybullet.multiplyTransforms(
            *pybullet.invertTransform(*self.target_pose()), *tooltip
        )
        suction = pybullet.createConstraint(
            self._robot.body,
            self._robot.cup,
            self._target,
            -1,
            pybullet.JOINT_FIXED,
            [0.0, 0.0, 0.0],
            on_cup[0],
            on_block[0],
            on_cup[1],
            on_block[1],
            physicsClientId=self._id,
        )
        pybullet.changeConstraint(suction, maxForce=force_n, physicsClientId=self._id)
        return suction, on_block[0]

    def _tooltip(self) -> Transform:
        state = pybullet.getLinkState(
            self._robot.body,
            self._robot.tooltip,
            computeForwardKinematics=True,
            physicsClientId=self._id,
        )
        return state[4], state[5]


def _center_of_mass(scene: Scenes, number: int) -> Floats:
    """(3,) of a block of the first scene, in its body frame."""
    center, half = block_boxes(scene, number)
    return np.asarray(np.average(center, axis=0, weights=np.prod(half, axis=1)))


def _pose(position: Sequence[float], orientation: Sequence[float]) -> tuple[Floats, Floats]:
    """Position (3,) and rotation (3, 3) of a transform."""
    rotation = np.reshape(pybullet.getMatrixFromQuaternion(orientation), (3, 3))
    return np.array(position), rotation


def _smooth(duration_s: float) -> Floats:
    """Shares (k,) of a way, one for each time step, that begins and ends at rest."""
    t = np.linspace(0.0, 1.0, math.ceil(duration_s / STEP_S) + 1)[1:]
    return t * t * (3.0 - 2.0 * t)
