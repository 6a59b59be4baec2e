"""Cameras in settings and in space, of whatever environment: intrinsics, samplings, rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat, NonNegativeInt, PositiveInt

from encoders.cameras import Sampling

Floats = NDArray[np.float64]
Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Intrinsics(BaseModel, frozen=True, extra="forbid"):
    """A pinhole camera, in pixels of the sensor; the first pixel's centre is at (0.5, 0.5)."""

    fx: float = Field(gt=0.0, allow_inf_nan=False, description="Focal length over a pixel's width.")
    fy: float = Field(
        gt=0.0, allow_inf_nan=False, description="Focal length over a pixel's height."
    )
    cx: FiniteFloat = Field(description="Column coordinate of the optical axis.")
    cy: FiniteFloat = Field(description="Row coordinate of the optical axis.")


class DistortionSettings(BaseModel, frozen=True, extra="forbid"):
    """How the lens departs from a pinhole, as OpenCV and ROS have it; see `Distortion`."""

    k1: FiniteFloat = Field(0.0, description="Radial, of the second power.")
    k2: FiniteFloat = Field(0.0, description="Radial, of the fourth power.")
    p1: FiniteFloat = Field(0.0, description="Tangential.")
    p2: FiniteFloat = Field(0.0, description="Tangential.")
    k3: FiniteFloat = Field(0.0, description="Radial, of the sixth power.")


class SamplingSettings(BaseModel, frozen=True, extra="forbid"):
    """Which of the sensor's pixels the network sees; part of the policy."""

    crop: tuple[NonNegativeInt, NonNegativeInt, PositiveInt, PositiveInt] | None = Field(
        None,
        description="[left, top, width, height] in sensor pixels; null: the whole image.",
    )
    every: PositiveInt = Field(
        1, description="Of the crop's columns and rows every so manyth is taken, from the first on."
    )

    def of_sensor(self, sensor_width: int, sensor_height: int) -> Sampling:
        """The pixels of a sensor of some size.

        Raises:
            ValueError: the crop leaves it.
        """
        left, top, width, height = self.crop or (0, 0, sensor_width, sensor_height)
        columns, rows = -(-width // self.every), -(-height // self.every)
        return Sampling(sensor_width, sensor_height, left, top, columns, rows, self.every)


def look_at(position_m: Floats, target_m: Floats, roll_rad: float = 0.0) -> Floats:
    """Rotation (3, 3) of a camera at `position_m` that looks at `target_m`.

    Upright without `roll_rad`, which turns it about its optical axis, clockwise seen from behind.
    """
    forward = np.asarray(target_m, float) - position_m
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:  # looking straight down or up: the image's right is -y
        right = np.array([0.0, -1.0, 0.0])
    right = right / np.linalg.norm(right)
    upright = np.stack([right, np.cross(forward, right), forward], axis=1)
    return upright @ euler_rotations(np.array([[0.0, 0.0, roll_rad]]))[0]


def yaw_rotations(yaw_rad: Floats) -> Floats:
    """Rotations (..., 3, 3) by angles (...) about the vertical."""
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    rotations = np.zeros((*np.shape(yaw_rad), 3, 3))
    rotations[..., 0, 0], rotations[..., 0, 1] = cosine, -sine
    rotations[..., 1, 0], rotations[..., 1, 1] = sine, cosine
    rotations[..., 2, 2] = 1.0
    return rotations


def euler_rotations(angles_rad: Floats) -> Floats:
    """Rotations (n, 3, 3) by angles (n, 3) about x, then y, then z."""
    sine, cosine = np.sin(angles_rad), np.cos(angles_rad)
    zero, one = np.zeros(len(angles_rad)), np.ones(len(angles_rad))

    def matrix(*rows: list[Floats]) -> Floats:
        return np.moveaxis(np.array(rows), -1, 0)

    (sx, sy, sz), (cx, cy, cz) = sine.T, cosine.T
    about_x = matrix([one, zero, zero], [zero, cx, -sx], [zero, sx, cx])
    about_y = matrix([cy, zero, sy], [zero, one, zero], [-sy, zero, cy])
    about_z = matrix([cz, -sz, zero], [sz, cz, zero], [zero, zero, one])
    return about_z @ about_y @ about_x
