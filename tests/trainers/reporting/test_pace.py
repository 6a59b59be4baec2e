"""Time left of a run."""

from __future__ import annotations

import pytest

from trainers.reporting.pace import LONGEST_WINDOW_S, Pace


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, in seconds."""
    time = [1000.0]
    monkeypatch.setattr("trainers.reporting.pace.time.monotonic", lambda: time[0])
    return time


def train(pace: Pace, now: list[float], first: int, last: int, speed: float) -> None:
    """Steps from `first` to `last`, a hundred at a time."""
    for step in range(first, last, 100):
        now[0] += 100 / speed
        pace.note_step(step + 100)


def test_nothing_is_known_before_the_first_step(now: list[float]) -> None:
    pace = Pace(50, 1000)
    assert pace.seconds_left is None
    now[0] += 1.0
    pace.note_step(50)
    assert pace.seconds_left is None


def test_a_steady_run_is_known_from_its_first_update(now: list[float]) -> None:
    pace = Pace(0, 10_000)
    for step in range(0, 10_000, 1000):
        train(pace, now, step, step + 1000, speed=50.0)
        assert pace.seconds_left == pytest.approx((9000 - step) / 50.0)


def test_what_it_began_with_is_forgotten(now: list[float]) -> None:
    pace = Pace(0, 100_000)
    train(pace, now, 0, 20_000, speed=2000.0)  # 10 s, without updates
    train(pace, now, 20_000, 30_000, speed=500.0)  # 20 s
    assert pace.seconds_left == pytest.approx(70_000 / 500.0)


def test_of_a_long_run_the_last_minutes_count(now: list[float]) -> None:
    pace = Pace(0, 10_000_000)
    train(pace, now, 0, 200_000, speed=100.0)  # 2000 s
    train(pace, now, 200_000, 320_000, speed=200.0)  # as long as the longest window
    assert LONGEST_WINDOW_S == 600.0
    assert pace.seconds_left == pytest.approx((10_000_000 - 320_000) / 200.0)


def test_evaluations_are_no_part_of_the_speed_and_those_to_come_count(now: list[float]) -> None:
    pace = Pace(0, 1050, interval=250, evaluation_s=2.0)
    train(pace, now, 0, 200, speed=10.0)
    # At 250, 500, 750, 1000 and the end.
    assert pace.seconds_left == pytest.approx(850 / 10.0 + 5 * 2.0)
    train(pace, now, 200, 300, speed=10.0)
    now[0] += 7.0
    pace.note_evaluation(7.0)
    train(pace, now, 300, 400, speed=10.0)
    assert pace.seconds_left == pytest.approx(650 / 10.0 + 4 * 7.0)
    train(pace, now, 400, 1100, speed=10.0)
    assert pace.seconds_left == 0.0
