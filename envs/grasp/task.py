"""The grasp task on N robots at once: what an action does, and what is true after it.

Everything is in the world frame, with arrays of leading length N, unless said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from envs.grasp.batch import Batch
from envs.grasp.robot.arm import Tools
from envs.grasp.scene.sampler import Scenes, heading
from envs.grasp.settings import Goal
from envs.grasp.simulators.base import Contacts
from rewards.grasp.transition import GraspTransition

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class GoalRegion(Batch):
    """The goal regions of n environments, in their block frames: arrays (n,)."""

    lateral_limit_m: Floats
    vertical_limit_m: Floats
    gap_min_m: Floats
    gap_limit_m: Floats
    yaw_limit_deg: Floats

    @classmethod
    def like(cls, goal: Goal, n: int) -> GoalRegion:
        """The same region n times."""
        return cls(*(np.full(n, getattr(goal, field.name)) for field in fields(cls)))

    @property
    def middle_m(self) -> Floats:
        """The middles (n, 3), in the block frames."""
        gap_m = (self.gap_min_m + self.gap_limit_m) / 2.0
        return np.stack([np.zeros_like(gap_m), np.zeros_like(gap_m), gap_m], axis=1)

    def position_is_right(self, offset_m: Floats) -> Bools:
        """Whether tooltips at (n, 3) of the block frame lie inside: (n,)."""
        lateral, vertical, gap = offset_m.T
        return np.asarray(
            (np.abs(lateral) <= self.lateral_limit_m)
            & (np.abs(vertical) <= self.vertical_limit_m)
            & (gap >= self.gap_min_m)
            & (gap <= self.gap_limit_m)
        )


@dataclass(frozen=True)
class EpisodeProgress(Batch):
    """Progress of N running episodes; arrays (N,)."""

    steps: NDArray[np.int64]
    touched: Bools
    collided: Bools
    position_right: Bools
    rotation_right: Bools

    @classmethod
    def start(cls, n: int) -> EpisodeProgress:
        """N episodes that have just begun."""
        return cls(np.zeros(n, np.int64), *(np.zeros(n, bool) for _ in range(4)))


def block_offset(tooltip_m: Floats, target_m: Floats, target_yaw_rad: Floats) -> Floats:
    """Tooltips (n, 3) in the frames of the target blocks: lateral x, vertical y, gap z."""
    cosine, sine = np.cos(target_yaw_rad), np.sin(target_yaw_rad)
    x, y, z = (tooltip_m - target_m).T
    # The normal is (-cos, -sin, 0), the lateral axis z cross normal: (sin, -cos, 0).
    return np.stack([x * sine - y * cosine, z, -x * cosine - y * sine], axis=1)


def yaw_error(yaw_rad: Floats, target_yaw_rad: Floats) -> Floats:
    """Signed angles (n,) in [-pi, pi) from the square yaw to the tool's."""
    return np.asarray((yaw_rad - target_yaw_rad + np.pi) % (2 * np.pi) - np.pi)


@dataclass(frozen=True)
class Motion:
    """N motions: the tools before and after, the time (N,) they took, and what was touched."""

    before: Tools
    after: Tools
    duration_s: Floats
    contacts: Contacts


def judge(
    motion: Motion, scenes: Scenes, region: GoalRegion, progress: EpisodeProgress
) -> GraspTransition:
    """Puts together what is true of N motions, before N scenes with these goals."""
    before, after = motion.before, motion.after
    offset = block_offset(after.tooltip_m, scenes.target_m, scenes.target_yaw_rad)
    error = yaw_error(after.yaw_rad, scenes.target_yaw_rad)
    position_right = region.position_is_right(offset)
    return GraspTransition(
        previous_tooltip_m=before.tooltip_m,
        tooltip_m=after.tooltip_m,
        tool_axis=after.axis,
        duration_s=motion.duration_s,
        target_point_m=scenes.target_m,
        target_normal=-heading(scenes.target_yaw_rad),
        offset_m=offset,
        yaw_error_rad=error,
        touched=motion.contacts.touched,
        collided=motion.contacts.collided,
        position_right=position_right,
        rotation_right=position_right & (np.abs(error) <= np.radians(region.yaw_limit_deg)),
        touched_before=progress.touched,
        position_right_before=progress.position_right,
        rotation_right_before=progress.rotation_right,
    )


def advance(progress: EpisodeProgress, transition: GraspTransition) -> EpisodeProgress:
    """The episodes' progress after a transition."""
    return replace(
        progress,
        steps=progress.steps + 1,
        touched=progress.touched | transition.touched,
        collided=progress.collided | transition.collided,
        position_right=progress.position_right | transition.position_right,
        rotation_right=progress.rotation_right | transition.rotation_right,
    )
