"""How figures are taken, by a clock that goes on only when it is told to."""

from __future__ import annotations

import pytest

from benchmarks.speed.figures import (
    FAST,
    OURS,
    PEER,
    PYBULLET,
    Case,
    Figures,
    Samples,
    growth,
    race,
    rate,
    speedup,
)


class Clock:
    """Goes on only when it is told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def spend(self, seconds: float) -> None:
        self.now_s += seconds


def test_samples_are_told_by_median_and_range() -> None:
    assert Samples((5.0, 1.0, 2.0)).spread == (2.0, 1.0, 5.0)
    assert Samples((1.0, 2.0, 4.0, 9.0)).spread[0] == 3.0
    assert str(Samples((1.5, 0.25, 2.0))) == "1.50 (0.25 to 2.00)"
    assert str(Samples((99.0, 1000.0, 2500.0))) == "1,000 (99 to 2,500)"


def test_a_ratio_is_taken_within_each_round() -> None:
    # The second round was slow for both: the ratio does not notice.
    ratio = Samples((10.0, 1.0, 12.0)) / Samples((5.0, 0.5, 4.0))
    assert ratio.values == (2.0, 2.0, 3.0)
    with pytest.raises(ValueError, match="shorter"):
        Samples((1.0, 2.0)) / Samples((1.0,))


def test_contenders_take_turns_and_stand_side_by_side() -> None:
    calls: list[str] = []

    def measure(name: str) -> dict[str, float]:
        calls.append(name)
        return {"steps": float(len(calls)), "updates": 7.0}

    teams = {("a", 64): "a", ("b", 64): "b", ("a", 256): "c"}
    measures = {team: lambda name=name: measure(name) for team, name in teams.items()}
    found = race(measures, 80, "stream", rounds=2)
    assert calls == ["a", "b", "c", "a", "b", "c"]
    assert found[Case("steps", 80, "stream", 64)] == {
        "a": Samples((1.0, 4.0)),
        "b": Samples((2.0, 5.0)),
    }
    assert found[Case("steps", 80, "stream", 256)] == {"a": Samples((3.0, 6.0))}
    assert found[Case("updates", 80, "stream", 64)]["b"] == Samples((7.0, 7.0))


def test_a_rate_is_work_over_the_time_it_took_and_preparation_does_not_count() -> None:
    clock = Clock()

    def work() -> int:
        clock.spend(0.4)
        return 10

    # Three times, because twice are only 0.8 s.
    speed = rate(work, 1.0, prepare=lambda: clock.spend(7.0), clock=clock)
    assert speed == pytest.approx(30 / 1.2)
    assert clock.now_s == pytest.approx(100.0 + 3 * 7.4)


def test_work_is_done_once_at_least() -> None:
    clock = Clock()

    def work() -> int:
        clock.spend(2.0)
        return 4

    assert rate(work, 0.0, clock=clock) == pytest.approx(2.0)


def test_each_is_compared_with_its_own_rival() -> None:
    a, b = Samples((8.0, 9.0)), Samples((4.0, 3.0))
    assert speedup({FAST: a, PYBULLET: b}) == Samples((2.0, 3.0))
    assert speedup({PEER: a, OURS: b}) == Samples((0.5, 1 / 3))
    assert speedup({FAST: a, PEER: b}) is None


def step_times(mode: str, times_s: dict[int, float]) -> Figures:
    return {Case("steps", 80, mode, n): {FAST: Samples((n / s,))} for n, s in times_s.items()}


def test_growth_is_the_exponent_of_the_time_of_a_step() -> None:
    in_proportion = step_times("stream", {64: 0.002, 256: 0.008, 1024: 0.032})
    by_half = step_times("frame grab", {64: 0.001, 256: 0.002})
    found = growth(in_proportion | by_half)
    assert found == pytest.approx({(80, "stream"): 1.0, (80, "frame grab"): 0.5})
    assert growth(step_times("stream", {64: 0.001})) == {}
