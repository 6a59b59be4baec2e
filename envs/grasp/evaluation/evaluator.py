"""Evaluation of policies that grasp: by their first action, by picks, and by pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from encoders.spaces import MM_PER_M, DepthImage, RgbImage
from envs.evaluation import (
    EvaluationOption,
    Evaluator,
    PhysicalCheckOption,
    RunFileOption,
    Unanswerable,
    error,
    rate,
)
from envs.grasp.evaluation.overlay import sheet
from envs.grasp.evaluation.pose_commands import PoseCommands
from envs.grasp.evaluation.report import GraspReport
from envs.grasp.evaluation.unanswerable import unanswerable
from envs.grasp.observations import observation_space
from envs.grasp.robot.arm import Arm
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.installation import require_pybullet

if TYPE_CHECKING:
    from envs.grasp.evaluation.pick import PickCheck

EVALUATION_OPTIONS: tuple[EvaluationOption, ...] = (
    RunFileOption("--simulator", "overrides `environment.simulator`", "environment.simulator"),
    PhysicalCheckOption("--pick", "have the robot pick up the block, in PyBullet"),
    PhysicalCheckOption("--window", "pick before your eyes, in PyBullet's window", window=True),
)


class GraspEvaluator(Evaluator):
    """Judges commanded poses. See `Evaluator`.

    Args:
        settings: the task.
        arm: the robot.
        commands: where actions would lead in the running episodes.
    """

    figures = (
        rate("collision", "collision rate", key="collision_rate", better="lower"),
        error("position_error_m", "position error", "mm", MM_PER_M),
        *(
            error(f"position_error_{axis}_m", f"position error {axis}", "mm", MM_PER_M)
            for axis in "xyz"
        ),
        error("yaw_error_deg", "yaw error", "deg"),
    )
    judges_first_action = True
    answer_limits: Mapping[str, float] = MappingProxyType(
        {"position_error_m": 0.010, "yaw_error_deg": 2.0, "collision": 0.0}
    )
    check_name = "pick"

    def __init__(
        self,
        settings: GraspSettings,
        arm: Arm,
        commands: Callable[[NDArray[Any]], PoseCommands],
    ):
        self._settings, self._arm, self._pose_commands = settings, arm, commands

    def physical_check(self, *, window: bool = False) -> PickCheck:
        """The pick; see `envs.grasp.evaluation.pick`.

        Raises:
            ValueError: PyBullet is not installed, or can't open a window.
        """
        require_pybullet("--window" if window else "--pick")
        # Imported late, as it imports PyBullet.
        from envs.grasp.evaluation.pick import PickCheck, Picker  # noqa: PLC0415

        settings = self._settings
        picker = Picker(self._arm, settings.support, settings.pick, window)
        return PickCheck(picker, self._pose_commands)

    def pictures(self) -> GraspReport:
        """Scenes, errors and a film; see `envs.grasp.evaluation.report`."""
        return GraspReport(self._settings, self._arm, self._pose_commands)

    def drawn(self, actions: NDArray[Any]) -> NDArray[np.uint8] | None:
        """See `Evaluator.drawn`; None where there are clouds of points alone."""
        spaces = observation_space(self._settings).spaces
        images = {n: s for n, s in spaces.items() if isinstance(s, DepthImage | RgbImage)}
        if not images:
            return None
        camera = min(images, key=lambda name: isinstance(images[name], RgbImage))  # depth, if any
        commands = self._pose_commands(actions)
        return sheet(commands, camera, images[camera], self._arm.robot.cup_radius_m)

    def unanswerable(self, count: int, seed: int) -> Iterator[Unanswerable]:
        """See `envs.grasp.evaluation.unanswerable`."""
        return unanswerable(self._settings, self._arm.robot, count, seed)
