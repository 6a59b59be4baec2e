"""Files that a run reports to: TensorBoard's and `status.json`."""

from __future__ import annotations

import json
import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from trainers.common.files import naming, write_atomically
from trainers.reporting.event_files import cut_after

_logger = logging.getLogger("ventosa")


class RunLog:
    """The log of one run, in its results directory: TensorBoard's event file and `status.json`.

    A run does not end because its log can't be written, on a full disk for instance: that is told
    once, and the log goes on, in a new event file, as soon as `status.json` can be written again.
    """

    def __init__(self, directory: Path, resumed_at: int | None = None) -> None:
        """Open a new event file.

        Args:
            directory: the run's results; created if need be.
            resumed_at: the step of the checkpoint from which the run goes on. What was logged
                after that step by the run that was cut off is taken back, so that no point is
                there twice: off its files, and off a TensorBoard that has read them. Points at
                that very step stay.

        Raises:
            OSError: the directory can't be written; names it.
        """
        self._directory = directory
        self._told = False
        # TensorBoard purges from `purge_step` on, that step included.
        purge_step = None if resumed_at is None else resumed_at + 1
        with naming(directory):
            directory.mkdir(parents=True, exist_ok=True)
            if resumed_at is not None:
                cut_after(directory, resumed_at)
            self._writer: SummaryWriter | None = SummaryWriter(
                str(directory), purge_step=purge_step
            )
            self._writer.flush()
        # The writer's thread prints what it fails of, beside keeping it for the next call.
        self._former_hook, threading.excepthook = threading.excepthook, self._on_thread_error

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Log one point of each curve; when this returns, they are in the file.

        Args:
            values: by tag, such as `Environment/Cumulative Reward`.
            step: environment steps taken.
        """

        def add(writer: SummaryWriter) -> None:
            for tag, value in values.items():
                writer.add_scalar(tag, value, step)

        self._write(add)

    def text(self, tag: str, text: str, step: int) -> None:
        """Log a text (TensorBoard shows it as Markdown)."""
        self._write(lambda writer: writer.add_text(tag, text, step))

    def images(self, tag: str, image: np.ndarray, step: int) -> None:
        """Log an image.

        Args:
            tag: its name.
            image: (height, width, 1 or 3) uint8.
            step: environment steps taken.
        """
        self._write(lambda writer: writer.add_image(tag, image, step, dataformats="HWC"))

    def hparams(self, values: Mapping[str, str | float], tags: Sequence[str]) -> None:
        """Log what runs are told apart by, for TensorBoard's page HParams.

        Args:
            values: by name; of this run.
            tags: of the curves that runs are compared by.
        """

        def add(writer: SummaryWriter) -> None:
            for summary in hparams(dict(values), dict.fromkeys(tags, 0.0)):
                writer._get_file_writer().add_summary(summary)

        self._write(add)

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
            if self._writer is None:
                self._writer = SummaryWriter(str(self._directory))
        except OSError as error:
            self._tell(error)

    def close(self) -> None:
        """Close the event file; nothing can be logged afterwards."""
        self._write(SummaryWriter.close)
        threading.excepthook = self._former_hook

    def _write(self, add: Callable[[SummaryWriter], None]) -> None:
        """Adds to the event file, and waits until it is there; nothing where that fails."""
        if self._writer is None:
            return
        try:
            add(self._writer)
            # The writer's thread keeps an error to itself until the next call.
            self._writer.flush()
        except OSError as error:
            self._writer = None
            self._tell(error)

    def _tell(self, error: OSError) -> None:
        if not self._told:
            self._told = True
            _logger.warning(
                "%s: the log can't be written (%s): the run goes on, and is logged again as soon "
                "as that can be",
                self._directory,
                error.strerror or error,
            )

    def _on_thread_error(self, failed: threading.ExceptHookArgs) -> None:
        if not issubclass(failed.exc_type, OSError):
            self._former_hook(failed)


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
