"""How the images of a policy are taken: in training, and by the real camera where it differs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Self

import gymnasium
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat, PositiveInt, model_validator

from encoders.cameras import Distortion, Pinhole, Sampling
from encoders.spaces import MM_PER_M, DepthImage, RgbImage
from envs.cameras import DistortionSettings, Intrinsics, Point, SamplingSettings, look_at
from envs.deployment import Mount

Unit = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class View(BaseModel, frozen=True, extra="forbid"):
    """How the images of one observation are taken.

    Attributes:
        sampling: which of the sensor's pixels the network sees.
        pinhole: in pixels of the sensor; None where it is unknown.
        distortion: of the lens.
        unit_per_m: raw depths of so much are one metre.
        mount: where the camera is; None where it is unknown.
    """

    sampling: Sampling
    pinhole: Pinhole | None = None
    distortion: Distortion = Distortion()
    unit_per_m: Unit = float(MM_PER_M)
    mount: Mount | None = None

    @classmethod
    def of(cls, space: DepthImage | RgbImage, mount: Mount | None) -> Self:
        """The view of training."""
        seen = space.pinhole if isinstance(space, DepthImage) else None
        sensor = None if seen is None else space.sampling.sensor_pinhole(seen)
        return cls(sampling=space.sampling, pinhole=sensor, mount=mount)

    def rays(self) -> NDArray[np.float64]:
        """(H, W, 3) the points at depth 1 that the pixels which the network sees look at.

        Raises:
            ValueError: the distortion can't be undone.
        """
        assert self.pinhole is not None
        seen = self.sampling.pinhole(self.pinhole)
        rays = seen.rays(self.sampling.height, self.sampling.width)
        return rays if self.distortion == Distortion() else self.distortion.undistorted(rays)

    def pixels(self, points_m: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Where points (k, 3) are on the sensor, (k, 2): column, row.

        None where that is unknown, or a point is not before the camera.
        """
        if self.pinhole is None or self.mount is None:
            return None
        local = (points_m - np.array(self.mount.position_m)) @ np.array(self.mount.rotation)
        if not (local[:, 2] > 0.0).all():
            return None
        rays = self.distortion.distorted(local / local[:, 2:])
        focal = (self.pinhole.fx, self.pinhole.fy)
        return rays[:, :2] * focal + (self.pinhole.cx, self.pinhole.cy)


def trained_views(space: gymnasium.spaces.Dict, mounts: Mapping[str, Mount]) -> dict[str, View]:
    """The views of training: of image observations, by name."""
    return {
        name: View.of(part, mounts.get(name))
        for name, part in space.spaces.items()
        if isinstance(part, DepthImage | RgbImage)
    }


class CameraFile(BaseModel, frozen=True, extra="forbid"):
    """A real camera, where it is not the one of training; lengths in pixels are the sensor's."""

    observation: str | None = Field(
        None, description="Whose camera it is, where a policy sees several images."
    )
    intrinsics: Intrinsics = Field(description="As the camera was calibrated.")
    distortion: DistortionSettings = Field(
        DistortionSettings(), description="Of the lens; 0 what is left out."
    )
    width: PositiveInt | None = Field(None, description="Of the sensor; null: as in training.")
    height: PositiveInt | None = Field(None, description="Of the sensor; null: as in training.")
    sampling: SamplingSettings | None = Field(
        None, description="Which pixels the network sees; null: as in training."
    )
    unit_per_m: Unit | None = Field(
        None, description="Raw depths of so much are one metre; null: millimetres, 1000."
    )
    position_m: Point | None = Field(
        None, description="Optical centre, in the robot's base frame; null: as in training."
    )
    target_m: Point | None = Field(None, description="The point it looks at.")
    roll_deg: FiniteFloat = Field(
        0.0, description="With target_m: turned about its axis, clockwise seen from behind it."
    )
    rotation: tuple[Point, Point, Point] | None = Field(
        None,
        description="In place of target_m: rows of the matrix whose columns are the camera's axes, "
        "x right, y down, z forward.",
    )

    @model_validator(mode="after")
    def _mount_is_whole(self) -> Self:
        if (self.position_m is None) != (self.target_m is None and self.rotation is None):
            raise ValueError("position_m goes with target_m or rotation: give both, or neither")
        if self.target_m is not None and self.rotation is not None:
            raise ValueError("target_m and rotation say the same thing: leave one of them out")
        if self.target_m is not None and self.target_m == self.position_m:
            raise ValueError("position_m and target_m are the same point: it looks nowhere")
        if self.rotation is not None and not _is_rotation(np.array(self.rotation)):
            raise ValueError("rotation is none: rows and columns of length 1, at right angles")
        return self

    def view(self, trained: View) -> View:
        """The view of this camera.

        Args:
            trained: that of training.

        Raises:
            ValueError: its sensor is another, and it doesn't say which of the pixels are taken.
        """
        return View(
            sampling=self._sampling(trained.sampling),
            pinhole=Pinhole(**self.intrinsics.model_dump()),
            distortion=Distortion(**self.distortion.model_dump()),
            unit_per_m=self.unit_per_m or trained.unit_per_m,
            mount=self._mount() or trained.mount,
        )

    def _sampling(self, trained: Sampling) -> Sampling:
        width, height = self.width or trained.sensor_width, self.height or trained.sensor_height
        if self.sampling is not None:
            sampling = self.sampling.of_sensor(width, height)
            if (sampling.width, sampling.height) != (trained.width, trained.height):
                raise ValueError(
                    f"sampling: takes {sampling.width}x{sampling.height} pixels (width x height), "
                    f"where the network sees {trained.width}x{trained.height}"
                )
            return sampling
        if (width, height) != (trained.sensor_width, trained.sensor_height):
            raise ValueError(
                f"a sensor of {width}x{height} pixels (width x height), where the policy was "
                f"trained for {trained.sensor_width}x{trained.sensor_height}: say with sampling "
                f"(crop, every) which {trained.width}x{trained.height} of them the network sees"
            )
        return replace(trained)

    def _mount(self) -> Mount | None:
        if self.position_m is None:
            return None
        if self.rotation is not None:
            # The nearest rotation: a file has its numbers rounded.
            left, _, right = np.linalg.svd(np.array(self.rotation))
            return Mount.of(np.array(self.position_m), left @ right)
        position_m, target_m = np.array(self.position_m), np.array(self.target_m)
        return Mount.of(position_m, look_at(position_m, target_m, np.radians(self.roll_deg)))


def _is_rotation(matrix: NDArray[np.float64]) -> bool:
    return bool(
        np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) and np.linalg.det(matrix) > 0.0
    )
