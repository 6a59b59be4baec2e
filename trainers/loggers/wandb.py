"""Weights & Biases, through its own package, the extra `wandb`."""

from __future__ import annotations

import html
import io
import secrets
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from trainers.common.command import require_extra
from trainers.loggers.animation import animated_gif
from trainers.loggers.base import LoggedRun, Logger

TIMEOUT_S = 15.0
"""For the service to answer when a run begins."""


class WeightsAndBiases(Logger):
    """Logs to Weights & Biases, in its own folder `wandb` where the command was started.

    Its steps are those of the environments. They only grow there: what a run that was cut off
    logged after its last checkpoint stays, and is not logged again when it is resumed.
    """

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """A run of Weights & Biases."""

        project: str = Field("ventosa", min_length=1, description="Project of the run.")
        entity: str | None = Field(None, description="User or team; null: your own.")
        group: str | None = Field(None, description="Group of the run, such as its task.")
        tags: tuple[str, ...] = Field((), description="Tags of the run.")
        mode: Literal["online", "offline"] | None = Field(
            None,
            description="`offline` keeps everything in files, for `wandb sync`; null: as the "
            "variable WANDB_MODE says, or online.",
        )

    @classmethod
    def check(cls, settings: Settings) -> None:
        """See `Logger.check`."""
        require_extra("wandb", "wandb")

    def __init__(self, settings: Settings, run: LoggedRun):
        # Imported late: it takes a second, and hardly any run needs it.
        import wandb  # noqa: PLC0415

        self._wandb = wandb
        self._run = wandb.init(
            project=settings.project,
            entity=settings.entity,
            group=settings.group,
            tags=settings.tags,
            mode=settings.mode,
            name=run.name,
            id=run.identifier("wandb", lambda: secrets.token_hex(4)),
            resume="allow",
            # It is to leave the terminal alone.
            settings=wandb.Settings(init_timeout=TIMEOUT_S, login_timeout=TIMEOUT_S, console="off"),
        )

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """See `Logger.scalars`."""
        self._run.log(dict(values), step=step)

    def text(self, tag: str, text: str, step: int) -> None:
        """See `Logger.text`."""
        self._run.log({tag: self._wandb.Html(f"<pre>{html.escape(text)}</pre>")}, step=step)

    def image(self, tag: str, image: NDArray[np.uint8], step: int) -> None:
        """See `Logger.image`."""
        self._run.log({tag: self._wandb.Image(image)}, step=step)

    def video(self, tag: str, frames: NDArray[np.uint8], fps: float, step: int) -> None:
        """See `Logger.video`."""
        gif = io.BytesIO(animated_gif(frames, fps))
        self._run.log({tag: self._wandb.Video(gif, format="gif")}, step=step)

    def hyperparameters(self, values: Mapping[str, Any], tags: Sequence[str]) -> None:
        """See `Logger.hyperparameters`; any curve can be compared there."""
        self._run.config.update(dict(values), allow_val_change=True)

    def close(self) -> None:
        """Waits until everything is uploaded."""
        self._run.finish()
