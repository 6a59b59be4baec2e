"""PoseCommands as they are judged and drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.evaluation.pick import Outcome
from envs.grasp.scene.sampler import Scenes
from envs.grasp.sensors.camera import CameraPoses

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PoseErrors:
    """Errors of n commands, and where they were made.

    Attributes:
        target_m: (n, 3) grasp points, world frame.
        target_yaw_deg: (n,) yaw that faces the target squarely.
        error_m: (n, 3) from the goal region's middle, in the block frame: lateral, vertical, gap.
        yaw_error_deg: (n,) signed.
        outcome: (n,) what the physical check said; empty text where there was none.
    """

    target_m: Floats
    target_yaw_deg: Floats
    error_m: Floats
    yaw_error_deg: Floats
    outcome: NDArray[np.str_]

    @property
    def distance_m(self) -> Floats:
        """(n,) to the goal region's middle."""
        return np.asarray(np.linalg.norm(self.error_m, axis=1))


@dataclass(frozen=True)
class Sample:
    """One aim to be drawn by itself: one row of scene and view, its image, and its judgement."""

    scene: Scenes
    view: CameraPoses
    image: NDArray[Any]
    tooltip_m: Floats
    yaw_rad: float
    judged: PoseErrors

    @property
    def caption(self) -> str:
        """Error of the aim, and what came of it."""
        judged = self.judged
        error = f"{judged.distance_m[0] * 1000:.1f} mm, {abs(judged.yaw_error_deg[0]):.1f} deg"
        return f"{error}   {outcome_label(judged.outcome[0])}".rstrip()


def outcome_label(outcome: str) -> str:
    """An outcome of the physical check in words."""
    return "picked" if outcome == Outcome.SUCCESS else outcome.replace("_", " ")
