from __future__ import annotations

import io
import re
import time
from typing import Any

import pytest
from rich.console import Console

from trainers.reporting.terminal import RunStatus, format_count, format_duration, make_display

LINE = RunStatus(
    step=1_234_567, reward=-12.3456, lesson=3, success=0.614, steps_per_second=2134.0,
    seconds_left=252.0,
)  # fmt: skip
LONGEST = RunStatus(4_999_999, -199.9994, 18, 1.0, 23_456.0, 23 * 3600 + 59 * 60)


def shown(*lines: RunStatus, terminal: bool, message: str = "", lessons: int = 19) -> str:
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=80)
    with make_display("grasp-01", 5_000_000, lessons, 1_200_000, console) as progress:
        for line in lines:
            progress.update(line)
        if message:
            progress.message(message)
    return file.getvalue()


def without_escapes(text: str) -> str:
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)


def test_plain_lines() -> None:
    assert shown(LINE, terminal=False).splitlines() == [
        "grasp-01: from step 1.2M to step 5M",
        "1.23M/5M  reward -12.346  lesson 4/19  success 61%  2.13k steps/s  4 min 12 s left",
    ]


def test_a_usual_plain_line_fits_into_80_columns() -> None:
    line = RunStatus(1_234_567, 0.512, 3, 0.61, 2134.0, 252.0)
    assert len(shown(line, terminal=False).splitlines()[-1]) <= 80


def test_plain_output_has_no_escapes_and_one_line_per_update() -> None:
    output = shown(LINE, LONGEST, LINE, terminal=False)
    assert "\x1b" not in output
    assert "\r" not in output
    assert len(output.splitlines()) == 4


def test_terminal_shows_the_same_facts() -> None:
    panel = without_escapes(shown(LINE, terminal=True))
    for fact in ("grasp-01", "1.23M / 5M", "25%", "reward -12.346", "lesson 4/19", "success 61%",
                 "2.13k steps/s", "4 min 12 s left"):  # fmt: skip
        assert fact in panel


def test_terminal_output_fits_into_its_width_without_losing_anything() -> None:
    panel = without_escapes(shown(LONGEST, terminal=True))
    assert all(len(line) <= 80 for line in re.split(r"[\r\n]+", panel))
    assert "…" not in panel
    for fact in ("reward -199.999", "lesson 19/19", "success 100%", "23.5k steps/s",
                 "23 h 59 min left"):  # fmt: skip
        assert fact in panel


def test_terminal_panel_is_redrawn_in_place_and_the_cursor_comes_back() -> None:
    output = shown(LINE, LONGEST, terminal=True)
    assert "\x1b[1A" in output  # a line up
    assert output.rindex("\x1b[?25h") > output.rindex("\x1b[?25l")  # cursor shown after hidden


def test_the_cursor_comes_back_after_an_error() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=80)
    progress = make_display("r", 10, 1, 0, console)
    with pytest.raises(KeyboardInterrupt), progress:
        raise KeyboardInterrupt
    assert "\x1b[?25h" in file.getvalue()


@pytest.mark.parametrize("terminal", [True, False])
def test_messages_come_out_word_for_word(terminal: bool) -> None:
    message = "camera range_m [0.4, 2.0] [red]x[/] :smile: /results/grasp-01/" + "long/" * 30
    assert message in without_escapes(shown(LINE, terminal=terminal, message=message))


@pytest.mark.parametrize("terminal", [True, False])
def test_unknown_figures_are_question_marks(terminal: bool) -> None:
    line = RunStatus(step=10, success=float("nan"), seconds_left=float("inf"))
    output = without_escapes(shown(line, terminal=terminal))
    for fact in ("reward ?", "success ?", "? steps/s", "? left"):
        assert fact in output


@pytest.mark.parametrize("terminal", [True, False])
def test_no_lesson_is_shown_where_there_is_but_one(terminal: bool) -> None:
    assert "lesson" not in shown(LINE, terminal=terminal, lessons=1)


def test_a_run_id_is_no_markup() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=80)
    with make_display("try [bold]1[/nope]", 10, 1, 0, console):
        pass
    assert "try [bold]1[/nope]" in without_escapes(file.getvalue())


def test_a_dumb_terminal_gets_plain_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    assert "\x1b[?25l" not in shown(LINE, terminal=True)


def test_the_bar_never_overshoots() -> None:
    assert " 100% " in without_escapes(shown(RunStatus(step=5_100_000), terminal=True))


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0, "0"), (7, "7"), (0.4, "0.4"), (999, "999"), (999.6, "1k"), (1000, "1k"),
        (12_345, "12.3k"), (123_456, "123k"), (999_499, "999k"), (999_500, "1M"),
        (1_234_567, "1.23M"), (5_000_000, "5M"), (100_000, "100k"), (2.5e9, "2.5G"),
        (-1500, "-1.5k"),
    ],
)  # fmt: skip
def test_counts(number: float, text: str) -> None:
    assert format_count(number) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"), (42.4, "42 s"), (59.6, "1 min 0 s"), (252, "4 min 12 s"),
        (3599.7, "1 h 0 min"), (3 * 3600 + 5 * 60 + 59, "3 h 5 min"),
        (2 * 86400 + 4 * 3600, "2 d 4 h"),
    ],
)  # fmt: skip
def test_durations(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


class Clock:
    """Time that passes when it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        monkeypatch.setattr("trainers.reporting.terminal.time.monotonic", lambda: self.now_s)


def live(width: int, file: io.StringIO) -> tuple[Any, Console]:
    console = Console(file=file, force_terminal=True, width=width)
    return make_display("grasp-01", 5_000_000, 19, 0, console), console


def test_the_time_left_runs_down_between_two_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, file = Clock(monkeypatch), io.StringIO()
    display, _ = live(80, file)
    with display:
        display.advance(LINE)
        clock.now_s += 12.0
    shown = without_escapes(file.getvalue())
    assert "4 min 0 s left" in shown.splitlines()[-3]
    with display:
        clock.now_s += 1000.0
    assert "0 s left" in without_escapes(file.getvalue()).splitlines()[-3]


def test_it_is_redrawn_by_itself() -> None:
    file = io.StringIO()
    display, _ = live(80, file)
    with display:
        display.advance(LINE)
        deadline = time.monotonic() + 60.0
        while "1.23M" not in file.getvalue():
            assert time.monotonic() < deadline
            time.sleep(0.05)


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_a_narrow_panel_loses_nothing(width: int) -> None:
    file = io.StringIO()
    display, _ = live(width, file)
    with display:
        display.update(LONGEST)
    panel = without_escapes(file.getvalue())
    assert all(len(line) <= min(width, 100) for line in re.split(r"[\r\n]+", panel))
    assert "…" not in panel
    for fact in ("reward -199.999", "lesson 19/19", "success 100%", "23.5k steps/s"):
        assert fact in panel


def test_what_a_narrower_terminal_wrapped_is_erased() -> None:
    file = io.StringIO()
    display, console = live(100, file)
    with display:
        display.update(LINE)
        drawn = len(file.getvalue())
        console.width = 40  # each of the four lines of 100 columns takes three of these
        display.message("narrower")
    first = file.getvalue()[drawn:].partition("narrower")[2]
    assert first.count("\x1b[1A") >= 4 * 2
    assert "╭─ grasp-01 ───────────────────────────╮" in without_escapes(first)


def test_no_color_means_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    panel = shown(LINE, terminal=True)
    assert "25%" in panel
    assert not re.search(r"\x1b\[[0-9;]*(3[0-9]|9[0-7]|38;)[0-9;]*m", panel)
