"""What a run reports to: its loggers, and `status.json`."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from trainers.common.errors import first_lines
from trainers.common.files import naming, write_atomically
from trainers.loggers.base import LoggedRun, Logger
from trainers.loggers.tensorboard import TensorBoard

_logger = logging.getLogger("ventosa")

RETRY_AFTER_S = 600.0
"""From a service's failure to the next try, which may take seconds itself."""

LoggerChoice = tuple[type[Logger], Any]
"""A logger's class and its settings."""
TENSORBOARD_ALONE: Mapping[str, LoggerChoice] = MappingProxyType(
    {"tensorboard": (TensorBoard, TensorBoard.Settings())}
)


class RunLog:
    """The log of one run: its loggers, and `status.json` in its results directory.

    A run does not end because its log can't be written, on a full disk or without a network for
    instance: that is told once, and the log goes on as soon as it can. Loggers that write into the
    run's folder go on when `status.json` can be written again.
    """

    def __init__(
        self,
        directory: Path,
        resumed_at: int | None = None,
        loggers: Mapping[str, LoggerChoice] = TENSORBOARD_ALONE,
    ) -> None:
        """Build the loggers.

        Args:
            directory: the run's results; created if need be.
            resumed_at: the step of the checkpoint from which the run goes on. What was logged
                after that step by the run that was cut off is taken back, or not logged again, so
                that no point is there twice. Points at that very step stay.
            loggers: by name.

        Raises:
            OSError: the directory can't be made; names it.
        """
        self._directory = directory
        self._told: set[str] = set()
        with naming(directory):
            directory.mkdir(parents=True, exist_ok=True)
        run = LoggedRun(directory, resumed_at)
        self._loggers = [
            _Guarded(name, choice, run, self._tell) for name, choice in loggers.items()
        ]

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Log one point of each curve; when this returns, TensorBoard's are in the file.

        Args:
            values: by tag, such as `Environment/Cumulative Reward`.
            step: environment steps taken.
        """
        self._each(lambda logger: logger.scalars(values, step))

    def text(self, tag: str, text: str, step: int) -> None:
        """Log a text, in Markdown."""
        self._each(lambda logger: logger.text(tag, text, step))

    def image(self, tag: str, image: np.ndarray, step: int) -> None:
        """Log an image.

        Args:
            tag: its name.
            image: (height, width, 1 or 3) uint8.
            step: environment steps taken.
        """
        self._each(lambda logger: logger.image(tag, image, step))

    def video(self, tag: str, frames: np.ndarray, fps: float, step: int) -> None:
        """Log frames in color (T, height, width, 3) uint8, so many a second."""
        self._each(lambda logger: logger.video(tag, frames, fps, step))

    def hyperparameters(self, values: Mapping[str, Any], tags: Sequence[str]) -> None:
        """Log what runs are told apart by; see `Logger.hyperparameters`."""
        self._each(lambda logger: logger.hyperparameters(values, tags))

    def status(self, values: Mapping[str, Any]) -> None:
        """Rewrite `status.json`; a reader sees the old content or the new, never a part.

        Args:
            values: nested dict, list and tuple of plain values, numpy values and paths. Numbers
                that are not finite become null, as JSON knows none.

        Raises:
            TypeError: a value is none of these.
        """
        content = json.dumps(_plain(values), indent=2, allow_nan=False, ensure_ascii=False)
        try:
            write_atomically(self._directory / "status.json", content + "\n")
        except OSError as error:
            self._tell(None, error)
        else:
            for logger in self._loggers:
                logger.go_on()

    def close(self) -> None:
        """Close the loggers; nothing can be logged afterwards."""
        self._each(lambda logger: logger.close())

    def _each(self, add: Callable[[Logger], None]) -> None:
        for logger in self._loggers:
            logger.use(add)

    def _tell(self, name: str | None, error: Exception) -> None:
        """Tells once of each logger that fails; of none where it is the run's folder."""
        what = "the log can't be written" if name is None else f"the logger {name!r} fails"
        if what in self._told:
            return
        self._told.add(what)
        reason = getattr(error, "strerror", None) or first_lines(error, 2) or type(error).__name__
        _logger.warning(
            "%s: %s (%s): the run goes on, and is logged again as soon as that can be",
            self._directory,
            what,
            reason,
        )


class _Guarded:
    """A logger whose failures do not end the run: it is built anew some time later.

    Args:
        name: which.
        choice: its class and settings.
        run: what it logs.
        tell: is told of failures.
    """

    def __init__(
        self,
        name: str,
        choice: LoggerChoice,
        run: LoggedRun,
        tell: Callable[[str | None, Exception], None],
    ):
        (self._cls, self._settings), self._run = choice, run
        self._name, self._tell = None if self._cls.in_run_folder else name, tell
        self._logger: Logger | None = None
        self._retry_s = -math.inf
        self.go_on()

    def use(self, add: Callable[[Logger], None]) -> None:
        """Adds to it, if it works."""
        if self._logger is None:
            return
        try:
            add(self._logger)
        except Exception as error:  # a service's client can fail in any way
            self._logger = None
            self._fail(error)

    def go_on(self) -> None:
        """Builds it, if it does not work and it is time to try."""
        if self._logger is not None or time.monotonic() < self._retry_s:
            return
        try:
            self._logger = self._cls(self._settings, self._run)  # type: ignore[call-arg]
        except Exception as error:
            self._fail(error)
        else:
            self._run = replace(self._run, resumed_at=None)

    def _fail(self, error: Exception) -> None:
        self._retry_s = time.monotonic() + (0.0 if self._name is None else RETRY_AFTER_S)
        self._tell(self._name, error)


def _plain(value: Any) -> Any:
    """The value as strict JSON can have it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
