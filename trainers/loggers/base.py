"""The contract of a logger: where a run's curves, texts, pictures and settings go."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from trainers.common.files import read_json, write_atomically

IDENTIFIERS = "loggers.json"
"""File in the run's folder: the identifiers that services know the run by, by their loggers."""


@dataclass(frozen=True)
class LoggedRun:
    """The run that is logged.

    Attributes:
        directory: its folder, which is there.
        resumed_at: the step of the checkpoint from which it goes on; None where it begins, or where
            nothing is to be taken back.
    """

    directory: Path
    resumed_at: int | None = None

    @property
    def name(self) -> str:
        """The run's name."""
        return self.directory.resolve().name

    def identifier(self, logger: str, new: Callable[[], str]) -> str:
        """Identifier that a service knows the run by; a run that is resumed finds its own again.

        Args:
            logger: whose service.
            new: gives one where there is none yet.
        """
        path = self.directory / IDENTIFIERS
        known = read_json(path) if path.exists() else {}
        if logger not in known:
            known[logger] = new()
            write_atomically(path, f"{json.dumps(known)}\n")
        return str(known[logger])


class Logger:
    """Where a run is logged. What a logger does not override, it leaves out.

    Built as `cls(settings, run)` when the run begins. Whatever it raises, also when it is built,
    does not end the run: it is told once, and the logger is built anew some time later.

    Attributes:
        Settings: the model of its entry in the run file's `loggers`.
        in_run_folder: it writes into the run's folder alone, so that it can go on as soon as
            anything can be written there.
    """

    Settings: ClassVar[type[BaseModel]]
    in_run_folder: ClassVar[bool] = False

    @classmethod
    def check(cls, settings: Any) -> None:
        """Refuses what can't be had, before anything of the run is there.

        Raises:
            UserError: a package is missing, for instance.
        """

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Logs a point of each curve, by its tag, at so many environment steps."""

    def text(self, tag: str, text: str, step: int) -> None:
        """Logs a text, in Markdown."""

    def image(self, tag: str, image: NDArray[np.uint8], step: int) -> None:
        """Logs an image (height, width, 1 or 3)."""

    def video(self, tag: str, frames: NDArray[np.uint8], fps: float, step: int) -> None:
        """Logs frames in color (T, height, width, 3), so many a second."""

    def hyperparameters(self, values: Mapping[str, Any], tags: Sequence[str]) -> None:
        """Logs what runs are told apart by.

        Args:
            values: the run file's sections, with every default; see `flat`.
            tags: of the curves whose last points runs are compared by.
        """

    def close(self) -> None:
        """Ends it; nothing is logged afterwards."""


def flat(values: Mapping[str, Any]) -> dict[str, str | float]:
    """Settings by their dotted paths: numbers and flags as they are, all else as text."""
    return dict(_leaves(values, ()))


def _leaves(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, str | float]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _leaves(inner, (*path, str(key)))
    elif isinstance(value, Sequence) and any(isinstance(item, Mapping) for item in value):
        yield from _leaves(dict(enumerate(value)), path)
    else:
        yield ".".join(path), value if isinstance(value, (str, float, int)) else json.dumps(value)
