"""The geometry of images: where the rays of pixels go, and which of a sensor's pixels are taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

ITERATIONS = 50
LARGEST_OFF = 1e-6  # of a ray at depth 1: a thousandth of a pixel
ArrayOrTensor = TypeVar("ArrayOrTensor", bound=Any)


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera, in pixels of the image. Camera axes: x right, y down, z forward.

    The centre of pixel (column c, row r) is at (c + 0.5, r + 0.5).

    Args:
        fx: focal length over the width of a pixel.
        fy: focal length over the height of a pixel.
        cx: column coordinate of the optical axis.
        cy: row coordinate of the optical axis.

    Raises:
        ValueError: a focal length is not finite or not over 0, or the centre is not finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        """Refuses what is no camera."""
        if not (0.0 < self.fx < np.inf and 0.0 < self.fy < np.inf):
            raise ValueError(
                f"focal lengths of {self.fx} and {self.fy} pixels must be finite and over 0"
            )
        if not np.isfinite((self.cx, self.cy)).all():
            raise ValueError(f"the optical axis at ({self.cx}, {self.cy}) pixels must be finite")

    def rays(self, height: int, width: int) -> NDArray[np.float64]:
        """(H, W, 3) the points at depth 1 that the centres of the pixels see."""
        columns = (np.arange(width) + 0.5 - self.cx) / self.fx
        rows = (np.arange(height) + 0.5 - self.cy) / self.fy
        x, y = np.meshgrid(columns, rows)
        return np.stack([x, y, np.ones_like(x)], axis=-1)


@dataclass(frozen=True)
class Sampling:
    """Which pixels of a sensor's image are taken.

    Args:
        sensor_width: columns of the raw image.
        sensor_height: rows of the raw image.
        left: the first column that is taken.
        top: the first row that is taken.
        width: columns of what is taken.
        height: rows of what is taken.
        every: sensor pixels from one that is taken to the next.

    Raises:
        ValueError: a pixel would be taken that the sensor does not have.
    """

    sensor_width: int
    sensor_height: int
    left: int
    top: int
    width: int
    height: int
    every: int

    def __post_init__(self) -> None:
        """Refuses what leaves the sensor."""
        column = self.left + (self.width - 1) * self.every
        row = self.top + (self.height - 1) * self.every
        if min(self.left, self.top) < 0 or min(self.width, self.height, self.every) < 1:
            raise ValueError(f"{self}: sizes and steps start at 1, places at 0")
        if column >= self.sensor_width or row >= self.sensor_height:
            raise ValueError(
                f"{self}: the last pixel is ({column}, {row}), and the sensor ends before "
                f"({self.sensor_width}, {self.sensor_height})"
            )

    @classmethod
    def whole(cls, height: int, width: int) -> Self:
        """All pixels of a sensor."""
        return cls(width, height, 0, 0, width, height, 1)

    def take(self, raw: ArrayOrTensor) -> ArrayOrTensor:
        """The pixels (..., height, width) of raw images (..., sensor_height, sensor_width)."""
        rows = slice(self.top, self.top + (self.height - 1) * self.every + 1, self.every)
        columns = slice(self.left, self.left + (self.width - 1) * self.every + 1, self.every)
        taken: ArrayOrTensor = raw[..., rows, columns]
        return taken

    def pinhole(self, sensor: Pinhole) -> Pinhole:
        """The camera of what is taken, from that of the sensor."""
        # Pixel c is the sensor's pixel left + every * c, and keeps its ray.
        return Pinhole(
            sensor.fx / self.every,
            sensor.fy / self.every,
            (sensor.cx - self.left - 0.5) / self.every + 0.5,
            (sensor.cy - self.top - 0.5) / self.every + 0.5,
        )

    def sensor_pinhole(self, seen: Pinhole) -> Pinhole:
        """The sensor's camera, from that of what is taken: the inverse of `pinhole`."""
        return Pinhole(
            seen.fx * self.every,
            seen.fy * self.every,
            (seen.cx - 0.5) * self.every + self.left + 0.5,
            (seen.cy - 0.5) * self.every + self.top + 0.5,
        )


@dataclass(frozen=True)
class Distortion:
    """How a lens departs from a pinhole: Brown (1971) and Conrady (1919), as in OpenCV and ROS.

    With x, y the ray's coordinates at depth 1 and r^2 = x^2 + y^2, the pixel is where a pinhole
    would see the ray (x', y'):

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

    Args:
        k1, k2, k3: radial.
        p1, p2: tangential.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def distorted(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where a pinhole would see rays (..., 3), whose third coordinate is 1."""
        x, y = rays[..., 0], rays[..., 1]
        r2 = x**2 + y**2
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        aside = 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x**2)
        down = self.p1 * (r2 + 2 * y**2) + 2 * self.p2 * x * y
        return np.stack([x * radial + aside, y * radial + down, np.ones_like(x)], axis=-1)

    def undistorted(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """The rays (..., 3) of pixels, where a pinhole's would be `rays`: `distorted`'s inverse.

        Raises:
            ValueError: there is none at some pixel: the lens would fold the image there.
        """
        found = rays.copy()
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(ITERATIONS):
                found += rays - self.distorted(found)
            off = np.abs(self.distorted(found) - rays).max()
        if not off < LARGEST_OFF:
            raise ValueError(
                f"{self} can't be undone over the whole image: are the coefficients in the order "
                "k1, k2, p1, p2, k3, and of this camera?"
            )
        return found
