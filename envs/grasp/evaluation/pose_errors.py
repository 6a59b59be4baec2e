"""Errors of commanded poses, and samples of them to be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.evaluation.outcome import Outcome
from envs.grasp.evaluation.pose_commands import PoseCommands
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.task import GoalRegion, block_offset, yaw_error

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PoseErrors:
    """Errors of n commands, and where they were made.

    Attributes:
        target_m: (n, 3) grasp points, world frame.
        target_yaw_deg: (n,) yaw that faces the target squarely.
        region: what counts as right.
        error_m: (n, 3) from the goal region's middle, in the block frame: lateral, vertical, gap.
        yaw_error_deg: (n,) signed.
        outcome: (n,) what the physical check said; empty text where there was none.
    """

    target_m: Floats
    target_yaw_deg: Floats
    region: GoalRegion
    error_m: Floats
    yaw_error_deg: Floats
    outcome: NDArray[np.str_]

    def __getitem__(self, rows: slice) -> PoseErrors:
        return PoseErrors(**{name: values[rows] for name, values in vars(self).items()})

    @property
    def misses(self) -> Floats:
        """(n,) the largest error in units of the goal region's own limit; to 1: none.

        Where a physical check failed it is infinite.
        """
        region = self.region
        half_gap_m = (region.gap_limit_m - region.gap_min_m) / 2.0
        limits_m = np.stack([region.lateral_limit_m, region.vertical_limit_m, half_gap_m], axis=1)
        position = np.max(np.abs(self.error_m) / limits_m, axis=1)
        yaw = np.abs(self.yaw_error_deg) / region.yaw_limit_deg
        failed = ~np.isin(self.outcome, ("", Outcome.SUCCESS))
        return np.where(failed, np.inf, np.maximum(position, yaw))

    @property
    def distance_m(self) -> Floats:
        """(n,) to the goal region's middle."""
        return np.asarray(np.linalg.norm(self.error_m, axis=1))

    @property
    def caption(self) -> str:
        """Error of the first command, and what came of it."""
        error = f"{self.distance_m[0] * 1000:.1f} mm, {abs(self.yaw_error_deg[0]):.1f} deg"
        return f"{error}   {outcome_label(self.outcome[0])}".rstrip()


def errors_of(commands: PoseCommands, outcomes: Mapping[str, NDArray[np.bool_]]) -> PoseErrors:
    """Errors of n commands, and what a physical check said of them, if it did, by name (n,)."""
    target_m, target_yaw_rad = commands.scenes.target_m, commands.scenes.target_yaw_rad
    offset_m = block_offset(commands.tooltip_m, target_m, target_yaw_rad)
    names = np.full(len(commands), "", dtype="<U32")
    for name, rows in outcomes.items():
        names[rows] = name
    return PoseErrors(
        target_m=target_m,
        target_yaw_deg=np.degrees(target_yaw_rad),
        region=commands.region,
        error_m=offset_m - commands.region.middle_m,
        yaw_error_deg=np.degrees(yaw_error(commands.yaw_rad, target_yaw_rad)),
        outcome=names,
    )


@dataclass(frozen=True)
class Sample:
    """One command to be drawn by itself: one row of scene, view and errors, and its image."""

    scene: Scenes
    view: CameraPoses
    image: NDArray[Any]
    tooltip_m: Floats
    yaw_rad: float
    errors: PoseErrors

    @property
    def caption(self) -> str:
        """Error of the command, and what came of it."""
        return self.errors.caption


def outcome_label(outcome: str) -> str:
    """An outcome of the physical check in words."""
    return "picked" if outcome == Outcome.SUCCESS else outcome.replace("_", " ")
