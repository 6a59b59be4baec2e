"""TensorBoard's event files, in the run's folder."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from trainers.loggers.animation import animated_gif
from trainers.loggers.base import LoggedRun, Logger, flat
from trainers.loggers.event_files import cut_after

IN_COLOR = 3
"""Colorspace of an image, as TensorBoard counts them."""


HYPERPARAMETERS = "_hparams_/session_start_info"
"""Tag of a run's hyper-parameters, as TensorBoard's page HParams looks for it."""


class TensorBoard(Logger):
    """Logs into an event file; what it is given is in the file when a method returns.

    What was logged after the checkpoint by the run that was cut off is taken back, so that no point
    is there twice: off its files, and off a TensorBoard that has read them.
    """

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """TensorBoard's event files, in the run's folder."""

    in_run_folder = True

    def __init__(self, settings: Settings, run: LoggedRun):
        step = run.resumed_at
        tags = set() if step is None else cut_after(run.directory, step)
        self._has_hyperparameters = HYPERPARAMETERS in tags
        # TensorBoard purges from `purge_step` on, that step included.
        self._writer = SummaryWriter(
            str(run.directory), purge_step=None if step is None else step + 1
        )
        self._writer.flush()
        # The writer's thread prints what it fails of, beside keeping it for the next call. It may
        # do so after that call, so that the hook of a writer that failed stays.
        self._former_hook, threading.excepthook = threading.excepthook, self._on_thread_error

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """See `Logger.scalars`."""
        with self._written():
            for tag, value in values.items():
                self._writer.add_scalar(tag, value, step)

    def text(self, tag: str, text: str, step: int) -> None:
        """See `Logger.text`."""
        with self._written():
            self._writer.add_text(tag, text, step)

    def image(self, tag: str, image: NDArray[np.uint8], step: int) -> None:
        """See `Logger.image`."""
        with self._written():
            self._writer.add_image(tag, image, step, dataformats="HWC")

    def video(self, tag: str, frames: NDArray[np.uint8], fps: float, step: int) -> None:
        """See `Logger.video`; it is among the images, and moves."""
        _, height, width, _ = frames.shape
        image = Summary.Image(
            height=height,
            width=width,
            colorspace=IN_COLOR,
            encoded_image_string=animated_gif(frames, fps),
        )
        with self._written():
            summary = Summary(value=[Summary.Value(tag=tag, image=image)])
            self._writer._get_file_writer().add_summary(summary, step)

    def hyperparameters(self, values: Mapping[str, Any], tags: Sequence[str]) -> None:
        """See `Logger.hyperparameters`; TensorBoard shows them on its page HParams.

        A run that goes on keeps those that it began with, for they can't be taken out of its files.
        """
        if self._has_hyperparameters:
            return
        # The third would say that the run has ended.
        about, begun, _ = hparams(flat(values), dict.fromkeys(tags, 0.0))
        with self._written():
            for summary in (about, begun):
                self._writer._get_file_writer().add_summary(summary)

    def close(self) -> None:
        """Closes the event file."""
        threading.excepthook = self._former_hook
        self._writer.close()

    @contextmanager
    def _written(self) -> Iterator[None]:
        yield
        # The writer's thread keeps an error to itself until the next call.
        self._writer.flush()

    def _on_thread_error(self, failed: threading.ExceptHookArgs) -> None:
        if not issubclass(failed.exc_type, OSError):
            self._former_hook(failed)
