"""MLflow, through its own package, the extra `mlflow`."""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from trainers.common.command import require_extra
from trainers.loggers.animation import animated_gif
from trainers.loggers.base import LoggedRun, Logger, flat

PATIENCE = {"MLFLOW_HTTP_REQUEST_TIMEOUT": "10", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2"}
"""With a server that does not answer, unless the environment says otherwise; MLflow's own waits for
minutes, and the run with it."""
PARAMS_PER_CALL = 100
"""Most that MLflow takes at once."""


class MLflow(Logger):
    """Logs to an MLflow server, or to a folder or a database of its own.

    A run that is resumed goes on there. Points that the one that was cut off logged after its last
    checkpoint can't be taken back, and are not logged again.
    """

    class Settings(BaseModel, frozen=True, extra="forbid"):
        """A run of MLflow."""

        tracking_uri: str | None = Field(
            None,
            min_length=1,
            description="Server (http://...), database (sqlite:///mlflow.db) or folder; null: as "
            "the variable MLFLOW_TRACKING_URI says, or MLflow's own default.",
        )
        experiment: str = Field("ventosa", min_length=1, description="Experiment of the run.")

    @classmethod
    def check(cls, settings: Settings) -> None:
        """See `Logger.check`."""
        require_extra("mlflow", "mlflow")

    def __init__(self, settings: Settings, run: LoggedRun):
        # Imported late: it takes seconds, and hardly any run needs it.
        from mlflow import MlflowClient  # noqa: PLC0415

        for name, value in PATIENCE.items():
            os.environ.setdefault(name, value)
        self._client = client = MlflowClient(settings.tracking_uri)

        def begin() -> str:
            experiment = client.get_experiment_by_name(settings.experiment)
            identifier = (
                client.create_experiment(settings.experiment)
                if experiment is None
                else experiment.experiment_id
            )
            return str(client.create_run(identifier, run_name=run.name).info.run_id)

        self._run_id = run.identifier("mlflow", begin)
        client.update_run(self._run_id, "RUNNING")
        self._last_steps = {} if run.resumed_at is None else dict(self._logged())

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """See `Logger.scalars`."""
        from mlflow.entities import Metric  # noqa: PLC0415

        now_ms = round(time.time() * 1000.0)
        named = {_name(tag): value for tag, value in values.items()}
        points = [
            Metric(name, float(value), now_ms, step)
            for name, value in named.items()
            if step > self._last_steps.get(name, -1)
        ]
        self._client.log_batch(self._run_id, metrics=points)

    def text(self, tag: str, text: str, step: int) -> None:
        """See `Logger.text`."""
        self._client.log_text(self._run_id, text, f"{_name(tag)}.md")

    def image(self, tag: str, image: NDArray[np.uint8], step: int) -> None:
        """See `Logger.image`."""
        self._client.log_image(self._run_id, image, key=_name(tag), step=step)

    def video(self, tag: str, frames: NDArray[np.uint8], fps: float, step: int) -> None:
        """See `Logger.video`."""
        folder, _, name = _name(tag).rpartition("/")
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory, f"{name} {step}.gif")
            path.write_bytes(animated_gif(frames, fps))
            self._client.log_artifact(self._run_id, str(path), folder or None)

    def hyperparameters(self, values: Mapping[str, Any], tags: Sequence[str]) -> None:
        """See `Logger.hyperparameters`; what a run began with can't be changed there."""
        from mlflow.entities import Param  # noqa: PLC0415

        known = self._client.get_run(self._run_id).data.params
        new = [Param(_name(k), str(v)) for k, v in flat(values).items() if _name(k) not in known]
        for begin in range(0, len(new), PARAMS_PER_CALL):
            self._client.log_batch(self._run_id, params=new[begin : begin + PARAMS_PER_CALL])

    def close(self) -> None:
        """Marks the run as ended."""
        self._client.set_terminated(self._run_id)

    def _logged(self) -> Iterator[tuple[str, int]]:
        """Curves that are there already, and the last step of each."""
        for name in self._client.get_run(self._run_id).data.metrics:
            history = self._client.get_metric_history(self._run_id, name)
            yield name, max(point.step for point in history)


def _name(tag: str) -> str:
    """A tag without what MLflow allows in no name."""
    return re.sub(r"[^\w\-. /]", "_", tag)
