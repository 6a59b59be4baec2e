"""Console output of a run: a live panel on a terminal, plain lines anywhere else."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from rich.columns import Columns
from rich.console import Console, Group
from rich.control import Control
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.segment import ControlType
from rich.table import Table
from rich.text import Text

_UNKNOWN = "?"
_LONGEST_TITLE = 50
_WIDEST_PANEL = 100
_REDRAWS_PER_S = 2.0
_ERASED_LINE_UP = ((ControlType.ERASE_IN_LINE, 2), (ControlType.CURSOR_UP, 1))


@dataclass(frozen=True)
class RunStatus:
    """Status of a run.

    Attributes:
        step: environment steps taken.
        reward: mean return of the last episodes; None before any has ended.
        lesson: index of the current lesson, from 0 (shown from 1).
        success: share of successful episodes, 0 to 1; None where there is none to show.
        steps_per_second: current speed, environment steps per second of wall clock.
        seconds_left: estimate for the rest of the run; None where there is none yet.
    """

    step: int
    reward: float | None = None
    lesson: int = 0
    success: float | None = None
    steps_per_second: float | None = None
    seconds_left: float | None = None


class TerminalDisplay(Protocol):
    """Shows a run's progress; used as a context manager around the run."""

    def update(self, line: RunStatus) -> None:
        """Show where the run stands, after a summary."""

    def advance(self, line: RunStatus) -> None:
        """Show where it stands between two summaries, where the display is redrawn."""

    def message(self, text: str) -> None:
        """Show a line of text that stays; it is printed as it is, without markup."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...


def make_display(
    run_id: str,
    max_steps: int,
    lesson_count: int,
    start_step: int = 0,
    console: Console | None = None,
) -> TerminalDisplay:
    """Choose the display that fits the console.

    Args:
        run_id: the run's name, shown as the title.
        max_steps: environment steps at which the run ends.
        lesson_count: lessons of the curriculum; with 1 or less no lesson is shown.
        start_step: the step at which the run starts or goes on.
        console: where to show it; standard output by default.
    """
    console = console or Console()
    live = console.is_terminal and not console.is_dumb_terminal
    display = _LiveDisplay if live else _PlainDisplay
    return display(console, run_id, max_steps, lesson_count, start_step)


def format_count(number: float) -> str:
    """A number with three significant digits: `999`, `12.3k`, `5M`."""
    for unit in ("", "k", "M", "G"):
        digits = max(0, 2 - math.floor(math.log10(max(abs(number), 1))))
        rounded = round(number, digits)
        if abs(rounded) < 1000 or unit == "G":
            break
        number /= 1000
    text = f"{rounded:.{digits}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text) + unit


def format_duration(duration_s: float) -> str:
    """A duration in seconds as its two largest units: `42 s`, `4 min 12 s`, `3 h 5 min`."""
    seconds = round(duration_s)
    minutes, hours, days = seconds // 60, seconds // 3600, seconds // 86400
    if days:
        return f"{days} d {hours % 24} h"
    if hours:
        return f"{hours} h {minutes % 60} min"
    if minutes:
        return f"{minutes} min {seconds % 60} s"
    return f"{seconds} s"


class _BaseDisplay:
    """Common parts of both displays."""

    def __init__(
        self, console: Console, run_id: str, max_steps: int, lesson_count: int, start_step: int
    ) -> None:
        self._console = console
        self._run_id = run_id
        self._max_steps = max_steps
        self._lesson_count = lesson_count
        self._start_step = start_step

    def message(self, text: str) -> None:
        """Print a line that stays."""
        self._console.print(text, markup=False, highlight=False, emoji=False, soft_wrap=True)

    def _figures(self, line: RunStatus) -> list[str]:
        lesson = (
            [f"lesson {line.lesson + 1}/{self._lesson_count}"] if self._lesson_count > 1 else []
        )
        success = (
            [f"success {_if_known(line.success, lambda share: f'{share:.0%}')}"]
            if line.success is not None
            else []
        )
        return [
            f"reward {_if_known(line.reward, lambda reward: f'{reward:.3f}')}",
            *lesson,
            *success,
            f"{_if_known(line.steps_per_second, format_count)} steps/s",
        ]


class _PlainDisplay(_BaseDisplay):
    """One line per update, for logs, pipes and terminals that can't do more."""

    def __enter__(self) -> Self:
        start = f" from step {format_count(self._start_step)}" if self._start_step else ""
        self.message(f"{self._run_id}:{start} to step {format_count(self._max_steps)}")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        pass

    def update(self, line: RunStatus) -> None:
        """Print one line."""
        position = f"{format_count(line.step)}/{format_count(self._max_steps)}"
        left = f"{_if_known(line.seconds_left, format_duration)} left"
        self.message("  ".join([position, *self._figures(line), left]))

    def advance(self, line: RunStatus) -> None:
        """Prints nothing."""


class _LiveDisplay(_BaseDisplay):
    """A panel that stays at the foot of the terminal; messages scroll by above it.

    It is redrawn by a thread, so that the time left runs down, and a terminal's new size is taken
    up, however long an update takes.
    """

    def __init__(
        self, console: Console, run_id: str, max_steps: int, lesson_count: int, start_step: int
    ) -> None:
        super().__init__(console, run_id, max_steps, lesson_count, start_step)
        self._latest = (RunStatus(step=start_step), time.monotonic())
        self._drawn = (self._panel(0), 0)  # and its width: none that a terminal wraps
        self._live = Live(
            console=console, get_renderable=self._redrawn, refresh_per_second=_REDRAWS_PER_S
        )

    def __enter__(self) -> Self:
        self._live.start(refresh=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._live.stop()

    def update(self, line: RunStatus) -> None:
        """Take down what the next panel shows."""
        self._latest = (line, time.monotonic())

    advance = update

    def _panel(self, width: int) -> Panel:
        line, noted_s = self._latest
        bar = Table.grid(padding=(0, 2, 0, 0), expand=True)
        bar.add_column(no_wrap=True)
        bar.add_column(ratio=1)
        bar.add_column(no_wrap=True)
        bar.add_column(no_wrap=True)
        position = f"{format_count(line.step)} / {format_count(self._max_steps)}"
        # A run may overshoot by part of its last batch.
        share = min(1.0, line.step / max(1, self._max_steps))
        left_s = line.seconds_left
        if left_s is not None:
            left_s = max(left_s - (time.monotonic() - noted_s), 0.0)
        left = f"{_if_known(left_s, format_duration)} left"
        bar.add_row(position, ProgressBar(total=1.0, completed=share), f"{share:.0%}", left)
        figures = Columns(map(Text, self._figures(line)), padding=(0, 3))
        # Text, not str: a run id may hold what rich would take for markup.
        title = Text(self._run_id, style="bold")
        title.truncate(_LONGEST_TITLE, overflow="ellipsis")
        return Panel(Group(bar, figures), title=title, title_align="left", width=width)

    def _redrawn(self) -> Panel:
        """The panel of now, in place of the last one."""
        now_width = self._console.width
        panel, width = self._drawn
        if width > now_width:
            # The terminal wrapped its lines, of which rich erases only as many as it drew.
            options = self._console.options.update(width=width)
            rows = len(self._console.render_lines(panel, options))
            more = rows * ((width - 1) // now_width)
            self._console.control(Control(*_ERASED_LINE_UP * more))
        width = min(now_width, _WIDEST_PANEL)
        self._drawn = (self._panel(width), width)
        return self._drawn[0]


def _if_known(value: float | None, form: Callable[[float], str]) -> str:
    return _UNKNOWN if value is None or not math.isfinite(value) else form(value)
