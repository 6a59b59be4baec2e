"""The pictures of an evaluation: what the policy saw and did, how far it was off, and a film."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.evaluation.pose_commands import PoseCommands
from envs.grasp.evaluation.pose_errors import PoseErrors, Sample, errors_of
from envs.grasp.robot.arm import Arm
from envs.grasp.sensors.clouds import cloud_camera
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.installation import has_pybullet
from envs.grasp.task import GoalRegion

Floats = NDArray[np.float64]

SHOWN = 24
FILMED, WORST_FILMED = 4, 2
NEEDED = ("matplotlib", "PIL")

_logger = logging.getLogger("ventosa")


class GraspReport:
    """Draws commands. Implements `envs.evaluation.EvaluationReport`.

    Args:
        settings: the task.
        arm: carries out what is filmed.
        commands: where actions would lead in the running episodes.

    Raises:
        ValueError: a package is missing.
    """

    file_names: tuple[str, ...] = (
        "episodes.png",
        "worst.png",
        "errors.png",
        "workspace.png",
        "film.gif",
    )

    def __init__(
        self,
        settings: GraspSettings,
        arm: Arm,
        commands: Callable[[NDArray[Any]], PoseCommands],
    ):
        if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
            raise ValueError(
                f"pictures are drawn with {missing[0]}, which is not installed: install ventosa "
                "with its extra `render`, pip install -e '.[render]'"
            )
        self._settings, self._arm, self._pose_commands = settings, arm, commands
        cameras = settings.cameras
        depth = [name for name, camera in cameras.items() if camera.type != "rgb"]
        self._camera = (depth or list(cameras))[0]
        self._errors: list[PoseErrors] = []
        self._samples: list[Sample] = []
        self._worst: list[Sample] = []
        self._picked = False

    def add(self, actions: NDArray[Any], outcomes: Mapping[str, NDArray[np.bool_]]) -> None:
        """See `EvaluationReport`."""
        commands = self._pose_commands(actions)
        errors = errors_of(commands, outcomes)
        self._errors.append(errors)
        self._picked = bool(outcomes)
        self._samples += [
            self._sample(commands, errors, slice(row, row + 1))
            for row in range(min(len(commands), SHOWN - len(self._samples)))
        ]
        worst = np.argsort(-errors.misses, kind="stable")[:SHOWN]
        self._worst += [self._sample(commands, errors, slice(row, row + 1)) for row in worst]
        self._worst = sorted(self._worst, key=lambda sample: -sample.errors.misses[0])[:SHOWN]

    def files(self) -> Iterator[tuple[str, bytes]]:
        """See `EvaluationReport`."""
        # Imported late: they need what an installation without pictures does not have.
        from envs.grasp.evaluation.plots import contact_sheet, error_histograms, workspace  # noqa: PLC0415

        errors, robot = _concatenate(self._errors), self._arm.robot
        episodes, worst, histograms, places, moving = self.file_names
        filmed = [*self._samples[:FILMED], *self._worst[:WORST_FILMED]]
        yield episodes, contact_sheet(self._samples, robot.cup_radius_m)
        yield worst, contact_sheet(self._worst, robot.cup_radius_m)
        yield histograms, error_histograms(errors)
        yield places, workspace(errors)
        if not has_pybullet():
            _logger.warning("no %s: it is made in PyBullet, which is not installed", moving)
            return
        from envs.grasp.evaluation.film import film  # noqa: PLC0415

        yield moving, film(filmed, self._settings, self._arm, self._picked)

    def _sample(self, commands: PoseCommands, errors: PoseErrors, row: slice) -> Sample:
        view, image = commands.views[self._camera][row], commands.images[self._camera][row][0]
        is_cloud = view.camera.type == "points"
        return Sample(
            scene=commands.scenes[row],
            view=view,
            # A copy: a view would keep the images of all episodes.
            image=cloud_camera(view.camera).image(image) if is_cloud else image.copy(),
            tooltip_m=commands.tooltip_m[row][0],
            yaw_rad=float(commands.yaw_rad[row][0]),
            errors=errors[row],
        )


def _concatenate(parts: list[PoseErrors]) -> PoseErrors:
    """All of them, one after the other."""
    regions = [part.region.arrays() for part in parts]
    arrays = {
        name: np.concatenate([vars(part)[name] for part in parts])
        for name in vars(parts[0])
        if name != "region"
    }
    region = {name: np.concatenate([one[name] for one in regions]) for name in regions[0]}
    return PoseErrors(region=GoalRegion(**region), **arrays)
