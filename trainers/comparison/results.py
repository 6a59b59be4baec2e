"""What a run left in its folder: status, held-out evaluation and curves."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat

from trainers.common.errors import UserError, reason
from trainers.runfile.yaml_document import read, shown
from trainers.saving.run_folder import CONFIGURATION
from trainers.saving.run_lock import is_held

STATUS, UNREADABLE = "status.json", "unreadable"
REWARD, SPEED = "Environment/Cumulative Reward", "Performance/Steps Per Second"
Curve = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Steps (k,) that rise, and values (k,)."""
NOTHING: Curve = (np.empty(0, np.int64), np.empty(0))


_Count = Annotated[int, Field(ge=0, lt=2**63)]


class _Status(BaseModel, frozen=True):
    """What is read of `status.json`."""

    state: str
    reason: str | None = None
    step: _Count = 0
    lesson: _Count | None = None
    lessons: _Count | None = None
    success: FiniteFloat | None = None
    evaluation: dict[str, FiniteFloat | dict[str, FiniteFloat | None] | None] | None = None


@dataclass(frozen=True)
class RunResult:
    """One run, finished or not.

    Attributes:
        folder: the run's.
        configuration: its resolved run file.
        status: what `status.json` says; empty where there is none.
        curves: by TensorBoard's tags.
    """

    folder: Path
    configuration: Mapping[str, Any]
    status: Mapping[str, Any] = field(default_factory=dict)
    curves: Mapping[str, Curve] = field(default_factory=dict)

    @property
    def seed(self) -> int:
        """Of the run."""
        seed: int = self.configuration.get("seed", 0)
        return seed

    @property
    def step(self) -> int:
        """How far it came."""
        step: int = self.status.get("step", 0)
        return step

    @property
    def evaluation(self) -> Mapping[str, Any]:
        """The last held-out evaluation; empty where there was none."""
        return self.status.get("evaluation") or {}

    @property
    def reward(self) -> Curve:
        """The mean cumulative reward of episodes."""
        return self.curves.get(REWARD, NOTHING)

    @property
    def is_unreadable(self) -> bool:
        """Whether its files are damaged; the status has the reason."""
        return self.status.get("state") == UNREADABLE

    @property
    def cut_at(self) -> int | None:
        """The step that its curves end at, where the run itself came farther; None: they are whole.

        Event files that were cut short, or are missing, tell less than `status.json` does.
        """
        steps = np.unique(np.concatenate([NOTHING[0], *(c[0] for c in self.curves.values())]))
        last, interval = (int(steps[-1]), np.diff(steps, prepend=0).max()) if len(steps) else (0, 0)
        return last if self.step - last > 2 * interval else None

    @property
    def seconds(self) -> float:
        """What all steps took, pauses between them left out."""
        steps, rates = self.curves.get(SPEED, NOTHING)
        return float(np.sum(np.diff(steps, prepend=0) / np.maximum(rates, 1e-9)))


def read_run(folder: Path) -> RunResult:
    """Reads a run's folder, wherever it was made and however far it came.

    Raises:
        UserError: it is no run's folder, or its files are not what a run writes.
    """
    if not (folder / CONFIGURATION).is_file():
        raise UserError(f"{folder}: this is no run: it has no {CONFIGURATION}")
    configuration = read(folder / CONFIGURATION).data
    if type(seed := configuration.get("seed", 0)) is not int:
        raise UserError(
            f"{folder / CONFIGURATION}: seed: should be a whole number, not {shown(seed)}"
        )
    curves = Curves(folder)
    return RunResult(
        folder, configuration, read_status(folder), {tag: curves.curve(tag) for tag in curves.tags}
    )


def read_what_is_left(folder: Path) -> RunResult:
    """The same of a folder that may be damaged or missing, which its state then tells of."""
    if not (folder / CONFIGURATION).is_file():
        return RunResult(folder, {}, {"state": "never begun"})
    try:
        return read_run(folder)
    except UserError as error:
        return RunResult(folder, {}, {"state": UNREADABLE, "reason": str(error)})


def read_status(folder: Path) -> dict[str, Any]:
    """What a run's `status.json` says; empty where there is none.

    A process that was killed leaves "running" there: without one, the run is interrupted.

    Raises:
        UserError: it is damaged.
    """
    status = _written_status(folder)
    if status.get("state") == "running" and not is_held(folder):
        status = _written_status(folder)  # it may have ended between the two looks
        if status.get("state") == "running":
            status |= {"state": "interrupted", "reason": "its process was killed"}
    return status


def _written_status(folder: Path) -> dict[str, Any]:
    path = folder / STATUS
    if not path.is_file():
        return {}
    try:
        return _Status.model_validate_json(path.read_bytes(), strict=True).model_dump()
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: can't be read: {reason(error)}") from error


class Curves:
    """Curves of a run's scalars, also while it goes on.

    What an event file that was cut short still has is there.

    Args:
        folder: the run's, which exists.
    """

    def __init__(self, folder: Path):
        # Imported late: it takes seconds.
        from tensorboard.backend.event_processing.event_accumulator import (  # noqa: PLC0415
            EventAccumulator,
        )

        logging.getLogger("tensorboard").setLevel(logging.ERROR)
        self._events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
        self.reload()

    def reload(self) -> None:
        """Reads what was logged since."""
        self._events.Reload()

    @property
    def tags(self) -> list[str]:
        """Names of the curves."""
        return list(self._events.Tags()["scalars"])

    def curve(self, tag: str) -> Curve:
        """One of them."""
        points = {event.step: event.value for event in self._events.Scalars(tag)}
        steps = sorted(points)
        values = np.array([points[step] for step in steps], np.float64)
        return np.array(steps, np.int64), values
