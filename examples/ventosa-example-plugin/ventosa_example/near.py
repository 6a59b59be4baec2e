"""The reward `near`."""

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from rewards.grasp.transition import GraspTransition


class Near:
    """exp(-distance / scale): 1 at the grasp point, falling towards 0 away from it."""

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `near`."""

        scale_m: float = Field(0.1, gt=0, description="Distance in metres that divides it by e.")

    def __init__(self, settings: Settings) -> None:
        self.scale_m = settings.scale_m

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Return the reward of N transitions, shape (N,)."""
        to_target_m = transition.target_point_m - transition.tooltip_m
        return np.exp(-np.linalg.norm(to_target_m, axis=-1) / self.scale_m)
