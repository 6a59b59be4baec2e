"""How long the rest of a run takes."""

from __future__ import annotations

import time
from collections import deque

LONGEST_WINDOW_S = 600.0
RESOLUTION_S = 0.2
"""Between two points that are kept: a run may have thousands of updates a second."""


class Pace:
    """Estimates the time left, from the speed of late and the evaluations to come.

    The speed is that over the later half of the time that the run has trained, of ten minutes at
    most. So it forgets the beginning, where kernels are compiled, a replay buffer is filled without
    updates and lessons are easy, and bears that a machine has other work for a minute. Evaluations
    are no part of it: each that is to come counts by itself, as long as the last one.

    Args:
        start_step: environment steps the run had when this process took it up.
        max_steps: steps of the whole run.
        interval: steps from one evaluation to the next; None where there are none.
        evaluation_s: seconds that an evaluation takes, as far as is known.
    """

    def __init__(
        self,
        start_step: int,
        max_steps: int,
        interval: int | None = None,
        evaluation_s: float = 0.0,
    ):
        self._max_steps, self._interval = max_steps, interval
        self._evaluation_s, self._start_s = evaluation_s, time.monotonic()
        self._points = deque([(0.0, start_step)])  # seconds of training, and steps by then
        self._newest = self._points[0]

    def note_step(self, step: int) -> None:
        """Takes down that the run has come to a step."""
        self._newest = now_s, _ = time.monotonic() - self._start_s, step
        if now_s - self._points[-1][0] >= RESOLUTION_S:
            self._points.append(self._newest)
        begin_s = now_s - min(now_s / 2.0, LONGEST_WINDOW_S)
        while len(self._points) > 1 and self._points[1][0] <= begin_s:
            self._points.popleft()

    def note_evaluation(self, seconds: float) -> None:
        """Takes down that an evaluation is over, which took so long."""
        self._evaluation_s = seconds
        self._start_s += seconds

    @property
    def seconds_left(self) -> float | None:
        """Estimate for the rest of the run, from the last step noted on; None: there is none."""
        (then_s, before), (now_s, step) = self._points[0], self._newest
        if step <= before or now_s <= then_s:
            return None
        training_s = (self._max_steps - step) * (now_s - then_s) / (step - before)
        return max(training_s, 0.0) + self._evaluations_left(step) * self._evaluation_s

    def _evaluations_left(self, step: int) -> int:
        """One at each whole interval, and one at the end."""
        if self._interval is None or step >= self._max_steps:
            return 0
        return -(-self._max_steps // self._interval) - step // self._interval
