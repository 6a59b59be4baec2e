"""Rewards for events (the paper's section "Rewards design" and its baseline)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat

from rewards.grasp.transition import Bools, GraspTransition


class Touch:
    """Reward for the first time in an episode that the cup touches the target block."""

    snapshot: ClassVar[type] = GraspTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `touch`."""

        amount: FiniteFloat = Field(
            default=0.1, ge=0, description="Reward for the first touch of an episode."
        )

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Rewards (N,)."""
        return _reward_first_time(
            self._settings.amount, transition.touched, transition.touched_before
        )


class Collision:
    """A punishment for every step with an undesired contact."""

    snapshot: ClassVar[type] = GraspTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `collision`."""

        amount: FiniteFloat = Field(
            default=-0.1, le=0, description="Reward, not positive, for each step with a collision."
        )

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Rewards (N,)."""
        return np.where(transition.collided, self._settings.amount, 0.0)


class Position:
    """Reward for the first time in an episode that the tooltip is inside the goal region."""

    snapshot: ClassVar[type] = GraspTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `position`."""

        amount: FiniteFloat = Field(
            default=0.5, ge=0, description="Reward for the first right position of an episode."
        )

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Rewards (N,)."""
        return _reward_first_time(
            self._settings.amount, transition.position_right, transition.position_right_before
        )


class Rotation:
    """Reward for the first time in an episode that rotation and position are both right."""

    snapshot: ClassVar[type] = GraspTransition

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """Settings of the reward `rotation`."""

        amount: FiniteFloat = Field(
            default=0.5, ge=0, description="Reward for the first right rotation of an episode."
        )

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def __call__(self, transition: GraspTransition) -> NDArray[np.float64]:
        """Rewards (N,)."""
        return _reward_first_time(
            self._settings.amount, transition.rotation_right, transition.rotation_right_before
        )


class Sparse(Rotation):
    """The paper's baseline, used alone: the first time position and rotation are both right."""

    class Settings(Rotation.Settings, frozen=True, extra="forbid"):
        """Settings of the reward `sparse`."""

        amount: FiniteFloat = Field(
            default=1.0, ge=0, description="Reward for the first success of an episode."
        )


def _reward_first_time(amount: float, now: Bools, before: Bools) -> NDArray[np.float64]:
    """Rewards (N,): the amount where something is so for the first time in an episode."""
    return np.where(now & ~before, amount, 0.0)
