from __future__ import annotations

import pytest

from benchmarks.speed.timing import Samples, interleave, rate


class Clock:
    """Goes on only when it is told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def spend(self, seconds: float) -> None:
        self.now_s += seconds


def test_samples_are_told_by_median_and_range() -> None:
    samples = Samples((5.0, 1.0, 2.0))
    assert (samples.median, samples.low, samples.high) == (2.0, 1.0, 5.0)
    assert Samples((1.0, 2.0, 4.0, 9.0)).median == 3.0


def test_a_ratio_is_taken_within_each_round() -> None:
    # The second round was slow for both: the ratio does not notice.
    ratio = Samples((10.0, 1.0, 12.0)) / Samples((5.0, 0.5, 4.0))
    assert ratio.values == (2.0, 2.0, 3.0)
    with pytest.raises(ValueError, match="shorter"):
        Samples((1.0, 2.0)) / Samples((1.0,))


def test_contenders_take_turns() -> None:
    calls: list[str] = []

    def measure(name: str) -> float:
        calls.append(name)
        return float(len(calls))

    found = interleave({"a": lambda: measure("a"), "b": lambda: measure("b")}, repeats=3)
    assert calls == ["a", "b", "a", "b", "a", "b"]
    assert found == {"a": [1.0, 3.0, 5.0], "b": [2.0, 4.0, 6.0]}


def test_a_rate_is_work_over_the_time_it_took() -> None:
    clock = Clock()

    def work() -> int:
        clock.spend(0.4)
        return 10

    # Three times, because twice are only 0.8 s.
    assert rate(work, 1.0, clock=clock) == pytest.approx(30 / 1.2)
    assert clock.now_s == pytest.approx(101.2)


def test_preparation_does_not_count() -> None:
    clock = Clock()

    def work() -> int:
        clock.spend(0.5)
        return 1

    assert rate(work, 1.0, prepare=lambda: clock.spend(7.0), clock=clock) == pytest.approx(2.0)
    assert clock.now_s == pytest.approx(100.0 + 2 * 7.5)


def test_work_is_done_once_at_least() -> None:
    clock = Clock()

    def work() -> int:
        clock.spend(2.0)
        return 4

    assert rate(work, 0.0, clock=clock) == pytest.approx(2.0)
