"""What the policies of the grasp task are used by, away from it: the pose and the cameras."""

from __future__ import annotations

import numpy as np

from encoders.spaces import MM_PER_M
from envs.cameras import Point
from envs.deployment import Deployment, Meaning, Mount, Quantity
from envs.grasp.robot.urdf import load_robot
from envs.grasp.sensors.camera import nominal_pose
from envs.grasp.settings import GraspSettings, Workspace

RIM_POINTS = 32
STEM_M = 0.08


def deployment(settings: GraspSettings) -> Deployment:
    """What a task's policies are used by."""
    meaning = Meaning(
        name="pose",
        quantities=_quantities(settings.workspace),
        is_place=True,
        outline=_cup(load_robot().cup_radius_m),
    )
    mounts = {name: Mount.of(*nominal_pose(camera)) for name, camera in settings.cameras.items()}
    return Deployment(meaning=meaning, mounts=mounts)


def _quantities(workspace: Workspace) -> tuple[Quantity, ...]:
    """The tooltip's position in the robot's base frame, and the tool's yaw."""
    lengths = {"x": workspace.x_m, "y": workspace.y_m, "z": workspace.z_m}
    low, high = np.radians(workspace.yaw_deg).tolist()
    yaw = Quantity(name="yaw_rad", low=low, high=high, label="yaw", unit="deg", scale=180.0 / np.pi)
    return (
        *(
            Quantity(name=f"{axis}_m", low=a, high=b, label=axis, unit="mm", scale=MM_PER_M)
            for axis, (a, b) in lengths.items()
        ),
        yaw,
    )


def _cup(radius_m: float) -> tuple[tuple[Point, ...], ...]:
    """The cup's rim and the tool's axis: x along the axis, y to the left, z up."""
    angles = np.linspace(0.0, 2.0 * np.pi, RIM_POINTS)
    rim = tuple((0.0, radius_m * float(np.cos(a)), radius_m * float(np.sin(a))) for a in angles)
    return rim, ((0.0, 0.0, 0.0), (-STEM_M, 0.0, 0.0))
