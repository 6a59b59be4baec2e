"""What an environment declares so that its policies can be used away from it: plain data."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat

from envs.cameras import Floats, Point, yaw_rotations

Polyline = tuple[Point, ...]

Correction = tuple[Floats, Floats]
"""An affine map of quantities: a matrix (A, A), and what is added (A,)."""

# x, y, z and the heading.
PLACE_SIZE = 4


class Quantity(BaseModel, frozen=True, extra="forbid"):
    """One number that a component of the action stands for, linearly over the action's bounds.

    Attributes:
        name: with its unit, such as `speed_m_s`.
        low, high: where the component is at its own bounds.
        label: what people call it.
        unit: what people read it in.
        scale: from the quantity's own unit to that one.
    """

    name: str
    low: FiniteFloat
    high: FiniteFloat
    label: str
    unit: str = ""
    scale: FiniteFloat = 1.0

    def shown(self, value: float, digits: str = ".2f") -> str:
        """A value as people read it: `yaw 3.21 deg`."""
        return " ".join(filter(None, (self.label, f"{value * self.scale:{digits}}", self.unit)))


class Meaning(BaseModel, frozen=True, extra="forbid"):
    """What actions (A,) mean.

    Attributes:
        name: of all quantities together.
        quantities: one for each component.
        is_place: the quantities are x, y and z in metres, and a heading about the vertical in
            radians, of something that stands upright in the frame that cameras' mounts are in.
        outline: lines to draw of it, in its own frame: x along the heading, z up, in metres.
    """

    name: str
    quantities: Annotated[tuple[Quantity, ...], Field(min_length=1)]
    is_place: bool = False
    outline: tuple[Polyline, ...] = ()

    def lines(self, values: NDArray[np.floating]) -> list[Floats]:
        """The outline (k, 3) at a place (4,), in the frame of the mounts."""
        x, y, z, heading = values.astype(np.float64)
        turned = yaw_rotations(heading)
        return [np.array(line) @ turned.T + (x, y, z) for line in self.outline]


class Mount(BaseModel, frozen=True, extra="forbid"):
    """Where a camera is.

    Attributes:
        position_m: its optical centre.
        rotation: rows of the matrix whose columns are the camera's axes: x right, y down, z
            forward.
    """

    position_m: Point
    rotation: tuple[Point, Point, Point]

    @classmethod
    def of(cls, position_m: Floats, rotation: Floats) -> Self:
        """A mount from arrays (3,) and (3, 3)."""
        return cls.model_validate(
            {"position_m": position_m.tolist(), "rotation": rotation.tolist()}
        )


class Deployment(BaseModel, frozen=True, extra="forbid"):
    """What is known of an environment's policies, away from it.

    Attributes:
        meaning: of its actions; None: they mean nothing but themselves.
        mounts: where the cameras of image observations are, by name, when nothing is drawn.
    """

    meaning: Meaning | None = None
    mounts: dict[str, Mount] = {}


# Beyond, what a policy says of something upright is of something tilted.
MAX_TILT_DEG = 5.0


def correction(nominal: Mount, real: Mount) -> Correction:
    """The affine map of places that were seen by a camera which is elsewhere than it was thought.

    A policy tells places as if its camera were where it was in training. A point p told so is
    really at T_real T_nominal^-1 p = R p + t. That is exact for positions. Headings are turned by
    the rotation about the vertical that is nearest to R (of least squares): exact where the rest of
    R is nothing, and within 0.12 degrees where it is `MAX_TILT_DEG`.

    Returns:
        Matrix (4, 4) and offset (4,): real = matrix @ told + offset.

    Raises:
        ValueError: the cameras differ by so much roll and pitch that nothing would stay upright.
    """
    turn = np.array(real.rotation) @ np.array(nominal.rotation).T
    tilt_deg = float(np.degrees(np.arccos(np.clip(turn[2, 2], -1.0, 1.0))))
    if tilt_deg > MAX_TILT_DEG:
        raise ValueError(
            f"the camera is tilted by {tilt_deg:.1f} deg against the one that the policy was "
            f"trained with, where {MAX_TILT_DEG:g} deg are borne: what is upright would not look "
            "upright to the policy; mount the camera as in training, or train with this one"
        )
    matrix = np.eye(PLACE_SIZE)
    matrix[:3, :3] = turn
    moved = np.array(real.position_m) - turn @ np.array(nominal.position_m)
    heading = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    return matrix, np.append(moved, heading)
