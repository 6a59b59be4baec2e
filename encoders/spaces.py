"""Spaces that say what their numbers mean: images of depths and colours, and point clouds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from encoders.cameras import Pinhole, Sampling

if TYPE_CHECKING:
    import torch

# The code of a pixel whose depth is not known, as real depth cameras have it.
NOTHING_SEEN = 0
# Of pictures for people: no depth has it.
NOTHING_SEEN_RGB = (128, 128, 128)
MM_PER_M = 1000
# Of codes, whose number floating-point arithmetic may miss by a little.
ROUNDING = 1e-6
UINT8_MAX = 255
UINT16_MAX = 65535

LARGEST_BOUND = float(np.finfo(np.float32).max)
"""Of floats: spaces that have no bounds say so with this, too."""

DepthEncoding = Literal["uint8", "uint16"]
Frame = Literal["camera", "base"]

COORDINATES = 3
CLOUD_PICTURE_PX = 120


class DepthImage(Box):
    """Depth images of one camera, of shape (height, width, 1), encoded as integers.

    - ``uint16``: millimetres, as a real depth camera delivers them.
    - ``uint8``: ``value_m = min + value * (max - min) / 255``
      ("Learning to Grasp from 2.5D images", equation *clamp*).

    **0 is "nothing seen"** in both, as real depth cameras say it: of what is missing, and of what
    is nearer or farther than the range. The space holds every value of its type, because a real
    camera goes beyond its nominal range; ``seen`` tells which of them are depths, and ``decode``
    puts all others at the far end.

    Args:
        height: Rows of the image.
        width: Columns of the image.
        range_m: Nearest and farthest depth of the camera, in metres.
        encoding: What one number of the image stands for.
        pinhole: The camera, for encoders that need to know it; None where it is unknown.
        sampling: Which of a sensor's pixels these are; None: all of them.

    Attributes:
        codes: First and last of those that stand for a depth in the range.
        zero_m: Depth whose code would be 0.
        codes_per_m: ``code = (depth_m - zero_m) * codes_per_m``, rounded and held within ``codes``.

    Raises:
        ValueError: The size, the range or the encoding makes no sense.
    """

    def __init__(
        self,
        height: int,
        width: int,
        range_m: tuple[float, float] = (0.4, 2.0),
        encoding: DepthEncoding = "uint16",
        pinhole: Pinhole | None = None,
        sampling: Sampling | None = None,
    ) -> None:
        if encoding not in ("uint8", "uint16"):
            raise ValueError(f"depth encoding {encoding!r} is unknown: use 'uint16' or 'uint8'")
        _check_size(height, width)
        min_m, max_m = (float(bound) for bound in range_m)
        if not 0 <= min_m < max_m < np.inf:
            raise ValueError(
                f"depth range [{min_m}, {max_m}] m must be finite and rise from 0 or more"
            )
        if encoding == "uint16" and max_m * MM_PER_M > UINT16_MAX:
            raise ValueError(
                f"a depth of {max_m} m does not fit in uint16 millimetres, which end at "
                f"{UINT16_MAX / MM_PER_M} m: lower the range's end or use the encoding 'uint8'"
            )
        self.sampling = _checked_sampling(height, width, sampling)
        top, dtype = (UINT8_MAX, np.uint8) if encoding == "uint8" else (UINT16_MAX, np.uint16)
        super().__init__(0, top, shape=(height, width, 1), dtype=dtype)
        self.range_m = (min_m, max_m)
        self.encoding = encoding
        self.pinhole = pinhole
        self.zero_m = min_m if encoding == "uint8" else 0.0
        self.codes_per_m = UINT8_MAX / (max_m - min_m) if encoding == "uint8" else float(MM_PER_M)
        low, high = ((end - self.zero_m) * self.codes_per_m for end in self.range_m)
        first, last = math.ceil(low - ROUNDING), math.floor(high + ROUNDING)
        self.codes = (max(first, NOTHING_SEEN + 1), last)
        if self.codes[0] > last:
            raise ValueError(
                f"depth range [{min_m}, {max_m}] m holds no whole millimetre, which uint16 counts: "
                "widen it or use the encoding 'uint8'"
            )

    def encode(self, metres: NDArray[np.floating]) -> NDArray[np.integer]:
        """Encodes depths as the camera would; `envs.grasp.sensors.depth.sense` must agree.

        Args:
            metres: Depths in metres, (..., height, width); infinite where nothing was hit.

        Returns:
            Rounded, and 0 outside the range, (..., height, width, 1), of the space's type.
        """
        min_m, max_m = self.range_m
        values = np.subtract(metres, self.zero_m)
        values *= self.codes_per_m
        # Not 0 but 1 for what rounds to it: only what is outside the range is "nothing seen".
        np.rint(values, out=values).clip(*self.codes, out=values)
        np.copyto(values, NOTHING_SEEN, where=~((metres >= min_m) & (metres <= max_m)))
        return values.astype(self.dtype)[..., np.newaxis]

    def decode(self, raw: torch.Tensor) -> torch.Tensor:
        """Turns raw images into metres within the range; "nothing seen" lies at its far end.

        Args:
            raw: Encoded depths of any shape, of the space's type.

        Returns:
            Depths in metres, of the same shape, float32.
        """
        return self.decode_seen(raw).clamp_(max=self.range_m[1])

    def decode_seen(self, raw: torch.Tensor) -> torch.Tensor:
        """As `decode`, but infinite where nothing was seen."""
        import torch  # noqa: PLC0415
        from torch.nn.functional import threshold  # noqa: PLC0415

        first, last = self.codes
        # torch has next to no arithmetic on uint16, so leave it first. What follows is in place: a
        # copy of all pixels for each operation would cost more than the operations. A threshold
        # takes a quarter of the time of a comparison and a masked fill.
        metres = threshold(raw.to(torch.float32, copy=True), first - 0.5, math.inf, inplace=True)
        if self.encoding == "uint16":  # whose codes go on beyond the last
            threshold(metres.neg_(), -last - 0.5, -math.inf, inplace=True).neg_()
        metres.div_(self.codes_per_m)
        return metres.add_(self.zero_m) if self.zero_m else metres

    def seen(self, raw: torch.Tensor) -> torch.Tensor:
        """Tells which pixels are depths inside the range.

        Args:
            raw: Encoded depths of any shape, of the space's type.

        Returns:
            Of the same shape, bool.
        """
        return self.decode_seen(raw).isfinite()

    def picture(self, frame: NDArray[np.integer]) -> NDArray[np.uint8]:
        """Draws one raw image (height, width, 1) for people.

        Returns:
            RGB (height, width, 3): near is warm, far is cold, "nothing seen" is gray.
        """
        first, last = self.codes
        codes = frame[..., 0].astype(np.float64)
        rgb = warm_to_cold(((last - codes) / max(last - first, 1)).clip(0.0, 1.0))
        rgb[(codes < first) | (codes > last)] = NOTHING_SEEN_RGB
        return rgb

    def __eq__(self, other: Any) -> bool:
        """Two depth spaces are equal when their numbers mean the same, too."""
        return isinstance(other, DepthImage) and super().__eq__(other) and self._key == other._key

    def __hash__(self) -> int:
        """Agrees with equality."""
        return hash((self.shape, self._key))

    def __repr__(self) -> str:
        """Says what the numbers mean, where a Box would list its bounds."""
        height, width, _ = self.shape
        camera = "" if self.pinhole is None else f", pinhole={self.pinhole}"
        sampling = _said(self.sampling)
        return (
            f"DepthImage({height}, {width}, range_m={self.range_m}, encoding={self.encoding!r}"
            f"{camera}{sampling})"
        )

    @property
    def _key(self) -> tuple[tuple[float, float], str, Pinhole | None, Sampling]:
        return self.range_m, self.encoding, self.pinhole, self.sampling


class RgbImage(Box):
    """Color images of one camera, uint8, of shape (height, width, 3).

    Args:
        height: Rows of the image.
        width: Columns of the image.
        sampling: Which of a sensor's pixels these are; None: all of them.

    Raises:
        ValueError: The size makes no sense.
    """

    def __init__(self, height: int, width: int, sampling: Sampling | None = None) -> None:
        _check_size(height, width)
        self.sampling = _checked_sampling(height, width, sampling)
        super().__init__(0, UINT8_MAX, shape=(height, width, 3), dtype=np.uint8)

    def picture(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Draws one image (height, width, 3) for people: as it is."""
        return frame

    def __eq__(self, other: Any) -> bool:
        """Two are equal when they are the same pixels of a sensor, too."""
        same = isinstance(other, RgbImage) and super().__eq__(other)
        return same and self.sampling == other.sampling

    def __hash__(self) -> int:
        """Agrees with equality."""
        return hash((self.shape, self.sampling))

    def __repr__(self) -> str:
        """Gives the size; everything else is fixed."""
        return f"RgbImage({self.shape[0]}, {self.shape[1]}{_said(self.sampling)})"


class PointCloud(Box):
    """Clouds of shape (points, 4), float32: x, y and z in metres, and 1; or four zeros.

    Four zeros are no point: every cloud has as many rows, however few points there are. The order
    of the rows means nothing.

    Args:
        points: Rows of a cloud.
        frame: Whose axes the coordinates are along: the camera's (x right, y down, z forward), or
            the robot's base's (x forward, y left, z up).
        middle_m: A point of that frame in the middle of what is seen; encoders count from it.

    Raises:
        ValueError: There is not a single row, the frame is unknown, or the middle is no point.
    """

    def __init__(
        self,
        points: int,
        frame: Frame = "camera",
        middle_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        if points < 1:
            raise ValueError(f"a cloud needs room for at least one point, not for {points}")
        if frame not in ("camera", "base"):
            raise ValueError(f"the frame {frame!r} of a cloud is unknown: use 'camera' or 'base'")
        if len(middle_m) != COORDINATES or not np.isfinite(middle_m).all():
            raise ValueError(f"middle_m {middle_m} must be three finite numbers")
        low, high = np.zeros((points, COORDINATES + 1)), np.ones((points, COORDINATES + 1))
        low[:, :COORDINATES], high[:, :COORDINATES] = -np.inf, np.inf
        super().__init__(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.frame: Frame = frame
        self.middle_m = (float(middle_m[0]), float(middle_m[1]), float(middle_m[2]))

    def picture(self, cloud: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Draws one cloud (points, 4) for people, as the camera sees it or from above the base.

        Returns:
            RGB (120, 120, 3) of all points without perspective: near is warm, far is cold, and
            where there is no point it is gray.
        """
        shape = (CLOUD_PICTURE_PX, CLOUD_PICTURE_PX, COORDINATES)
        drawn = np.full(shape, NOTHING_SEEN_RGB, np.uint8)
        points = cloud[cloud[:, COORDINATES] > 0.0, :COORDINATES].astype(np.float64)
        if not len(points):
            return drawn
        # From above, forward is up and the left is on the left.
        across, down, away = points.T if self.frame == "camera" else -points[:, [1, 0, 2]].T
        pixel_m = max(np.ptp(across), np.ptp(down), 1e-9) / (CLOUD_PICTURE_PX - 1)
        rows, columns = (
            np.rint((along - along.min()) / pixel_m).astype(np.int64) for along in (down, across)
        )
        nearness = (away.max() - away) / max(np.ptp(away), 1e-9)
        order = np.argsort(nearness)  # the nearest is drawn last
        drawn[rows[order], columns[order]] = warm_to_cold(nearness[order])
        return drawn

    def __eq__(self, other: Any) -> bool:
        """Two are equal when their numbers mean the same, too."""
        return isinstance(other, PointCloud) and self._key == other._key

    def __hash__(self) -> int:
        """Agrees with equality."""
        return hash(self._key)

    def __repr__(self) -> str:
        """Says what the numbers mean, where a Box would list its bounds."""
        return f"PointCloud({self.shape[0]}, {self.frame!r}, middle_m={self.middle_m})"

    @property
    def _key(self) -> tuple[int, str, tuple[float, float, float]]:
        return self.shape[0], self.frame, self.middle_m


def warm_to_cold(nearness: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colors (..., 3) of what is as near as can be, 1, and as far, 0; of shape (...)."""
    # Here, because simulators' processes import this module and do without.
    import cv2  # noqa: PLC0415

    levels = np.rint(nearness * UINT8_MAX).astype(np.uint8)
    bgr = cv2.applyColorMap(levels.reshape(-1, 1), cv2.COLORMAP_TURBO)
    return np.asarray(bgr[:, 0, ::-1], np.uint8).reshape(*nearness.shape, 3)


def bounded(space: Box) -> NDArray[np.bool_]:
    """Whether each number of a space has bounds on both sides, of the space's shape."""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    return (low > -LARGEST_BOUND) & (high < LARGEST_BOUND)


def low_and_span(space: Box) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What each number of a space begins at, and how far it goes from there, of the space's shape.

    Subtracted, and divided by, they bring it to [0, 1]. They are 0 and 1, which change nothing,
    where a bound is missing; the span of what can't vary is 1, too.
    """
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    span = np.where(high > low, high - low, 1.0)
    return np.where(bounded(space), low, 0.0), np.where(bounded(space), span, 1.0)


def _check_size(height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise ValueError(
            f"an image needs at least one pixel, not {width}x{height} (width x height)"
        )


def _checked_sampling(height: int, width: int, sampling: Sampling | None) -> Sampling:
    """The sampling; that of a whole sensor where there is none."""
    if sampling is None:
        return Sampling.whole(height, width)
    if (sampling.height, sampling.width) != (height, width):
        raise ValueError(f"{sampling} takes another size than {width}x{height} (width x height)")
    return sampling


def _said(sampling: Sampling) -> str:
    """For a representation: nothing where the whole sensor is taken."""
    whole = Sampling.whole(sampling.sensor_height, sampling.sensor_width)
    return "" if sampling == whole else f", sampling={sampling}"
