"""The environment's own reward, to be weighed against others."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from rewards.gym.transition import GymTransition


class EnvironmentReward:
    """The gymnasium environment's own reward."""

    snapshot: ClassVar[type] = GymTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `environment`: it has none."""

    def __init__(self, settings: Settings) -> None:
        pass

    def __call__(self, transition: GymTransition) -> NDArray[np.float64]:
        """Rewards (N,)."""
        return transition.rewards
