"""The log of those processes of a run that leave reporting to the first."""

from __future__ import annotations

from typing import Any

from trainers.reporting.event_log import RunLog


class SilentLog(RunLog):
    """Has no loggers, and writes nothing."""

    def __init__(self) -> None:
        self._loggers = []

    def status(self, values: Any) -> None:
        """See `RunLog.status`."""
