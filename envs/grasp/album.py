"""The album of an evaluation: what the policy saw and did, how far it was off, and a film."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.grasp.aims import Aims
from envs.grasp.camera import Views
from envs.grasp.pick import Outcome
from envs.grasp.scene import Scenes
from envs.grasp.settings import GraspSettings
from envs.grasp.task import block_offset, goal_middle_m, yaw_error

Floats = NDArray[np.float64]

SHOWN = 24
FILMED = 4
NEEDED = ("matplotlib", "PIL")


@dataclass(frozen=True)
class Judged:
    """How far n aims are off, and where.

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
class Shot:
    """One aim to be drawn by itself: one row of scene and view, its image, and its judgement."""

    scene: Scenes
    view: Views
    image: NDArray[Any]
    tooltip_m: Floats
    yaw_rad: float
    judged: Judged

    @property
    def caption(self) -> str:
        """How far the aim is off, and what came of it."""
        judged = self.judged
        error = f"{judged.distance_m[0] * 1000:.1f} mm, {abs(judged.yaw_error_deg[0]):.1f} deg"
        return f"{error}   {outcome_label(judged.outcome[0])}".rstrip()


def outcome_label(outcome: str) -> str:
    """An outcome of the physical check in words."""
    return "picked" if outcome == Outcome.SUCCESS else outcome.replace("_", " ")


class GraspAlbum:
    """Draws aims. Implements `envs.environment.Album`.

    Args:
        settings: the task.
        aims: where actions would lead in the running episodes.

    Raises:
        ValueError: a package is missing.
    """

    file_names: tuple[str, ...] = ("episodes.png", "errors.png", "workspace.png", "film.gif")

    def __init__(self, settings: GraspSettings, aims: Callable[[NDArray[Any]], Aims]):
        if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
            raise ValueError(
                f"pictures are drawn with {missing[0]}, which is not installed: install ventosa "
                "with its extra `render`, pip install -e '.[render]'"
            )
        self._settings, self._aims = settings, aims
        cameras = settings.cameras
        depth = [name for name, camera in cameras.items() if camera.type == "depth"]
        self._camera = (depth or list(cameras))[0]
        self._judged: list[Judged] = []
        self._shots: list[Shot] = []
        self._picked = False

    def add(self, actions: NDArray[Any], outcomes: Mapping[str, NDArray[np.bool_]]) -> None:
        """See `Album`."""
        aims = self._aims(actions)
        judged = self._judge(aims, outcomes)
        self._judged.append(judged)
        self._picked = bool(outcomes)
        self._shots += [
            self._shot(aims, judged, slice(row, row + 1))
            for row in range(min(len(aims), SHOWN - len(self._shots)))
        ]

    def files(self) -> Iterator[tuple[str, bytes]]:
        """See `Album`."""
        # Imported late: they need what an installation without pictures does not have.
        from envs.grasp.figures import contact_sheet, error_histograms, workspace  # noqa: PLC0415
        from envs.grasp.film import film  # noqa: PLC0415

        settings, judged = self._settings, _concatenate(self._judged)
        episodes, errors, places, moving = self.file_names
        yield episodes, contact_sheet(self._shots, goal_middle_m(settings.goal))
        yield errors, error_histograms(judged, settings.goal)
        yield places, workspace(judged)
        yield moving, film(self._shots[:FILMED], settings.support, settings.pick, self._picked)

    def _judge(self, aims: Aims, outcomes: Mapping[str, NDArray[np.bool_]]) -> Judged:
        target_m, target_yaw_rad = aims.scenes.target_m, aims.scenes.target_yaw_rad
        offset_m = block_offset(aims.tooltip_m, target_m, target_yaw_rad)
        names = np.full(len(aims), "", dtype="<U32")
        for name, rows in outcomes.items():
            names[rows] = name
        return Judged(
            target_m=target_m,
            target_yaw_deg=np.degrees(target_yaw_rad),
            error_m=offset_m - goal_middle_m(self._settings.goal),
            yaw_error_deg=np.degrees(yaw_error(aims.yaw_rad, target_yaw_rad)),
            outcome=names,
        )

    def _shot(self, aims: Aims, judged: Judged, row: slice) -> Shot:
        return Shot(
            scene=aims.scenes[row],
            view=aims.views[self._camera][row],
            image=aims.images[self._camera][row][0],
            tooltip_m=aims.tooltip_m[row][0],
            yaw_rad=float(aims.yaw_rad[row][0]),
            judged=Judged(**{name: values[row] for name, values in vars(judged).items()}),
        )


def _concatenate(parts: list[Judged]) -> Judged:
    return Judged(
        **{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])}
    )
