"""Rewards of every step, which tell how well an action went (the paper's "Rewards design")."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat

from rewards.grasp.transition import GraspTransition


class Approach:
    """Reward for motion towards the target: gain * (v . n), the paper's `dir_func` and `fmt`.

    v is the tooltip's displacement over the action (m), or its mean velocity (m/s); n is the unit
    vector from the *new* tooltip to the grasp point. The distance to a point is convex, so v . n
    with the new position is never more than the distance gained: overshooting is punished, and
    with `per_step` no closed path earns anything. With `per_second` that holds as long as all
    motions take the same time.
    """

    snapshot: ClassVar[type] = GraspTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `approach`."""

        gain: FiniteFloat = Field(
            default=0.03,
            ge=0,
            description="Reward per metre towards the target (or per m/s, with per_second).",
        )
        velocity: Literal["per_step", "per_second"] = Field(
            default="per_step",
            description="Whether v is the displacement of one step or is divided by its duration.",
        )

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Rewards (N,); 0 where the tooltip is on the target or no time passed."""
        velocity = transition.tooltip_m - transition.previous_tooltip_m
        if self._settings.velocity == "per_second":
            velocity = _divide(velocity, transition.duration_s[:, None])
        to_target_m = transition.target_point_m - transition.tooltip_m
        direction = _divide(to_target_m, np.linalg.norm(to_target_m, axis=1, keepdims=True))
        return self._settings.gain * _dot(velocity, direction)


class Facing:
    """Reward for a cup turned towards the face: -gain * (n_block . z_tool), the paper's `or_func`.

    Positive when the tool looks at the face, which is when its axis is opposite to the normal.
    """

    snapshot: ClassVar[type] = GraspTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `facing`."""

        gain: FiniteFloat = Field(
            default=0.01, ge=0, description="Reward per step for a tool squarely facing the block."
        )

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Rewards (N,)."""
        return -self._settings.gain * _dot(transition.target_normal, transition.tool_axis)


class Precision:
    """Reward for exactness: -gain * sum_i log(1 + (e_i / s_i)^2) / 2 over four errors e_i.

    The errors are those sideways, up, in the gap (to `gap_m`) and in yaw. Well over its scale s_i
    an error costs its logarithm: halving it pays the same whether it is large or small, so that the
    gradient does not fade as a policy becomes exact, and one hopeless scene does not outweigh the
    others. It is also why exploration settles at about the size of the errors: seen from further
    away than its own width the logarithm is convex (wider noise pays), nearer it is concave
    (narrower noise does).
    """

    snapshot: ClassVar[type] = GraspTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `precision`."""

        gain: FiniteFloat = Field(
            default=0.1, ge=0, description="Reward for making one error smaller by a factor of e."
        )
        position_scale_m: FiniteFloat = Field(
            default=0.005, gt=0, description="Errors of position well below this cost nothing."
        )
        yaw_scale_deg: FiniteFloat = Field(
            default=1.0, gt=0, description="Errors of yaw well below this cost nothing."
        )
        gap_m: FiniteFloat = Field(
            default=0.015, description="The gap between cup and face that has no error."
        )

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Rewards (N,), never positive."""
        settings = self._settings
        offset = (transition.offset_m - [0.0, 0.0, settings.gap_m]) / settings.position_scale_m
        yaw = transition.yaw_error_rad / np.radians(settings.yaw_scale_deg)
        errors = np.column_stack([offset, yaw])
        return np.asarray(-0.5 * settings.gain * np.log1p(errors**2).sum(axis=1))


def _dot(left: NDArray, right: NDArray) -> NDArray[np.float64]:
    """Inner products (N,) of two arrays of vectors, (N, 3)."""
    return np.einsum("ni,ni->n", left, right, dtype=np.float64)


def _divide(vectors: NDArray, by: NDArray) -> NDArray[np.float64]:
    """Vectors (N, 3) over numbers (N, 1); a division by zero gives the zero vector."""
    quotient = np.zeros(vectors.shape, dtype=np.float64)
    return np.divide(vectors, by, out=quotient, where=by > 0)
