from __future__ import annotations

import pytest

from benchmarks.speed.figures import FAST, OURS, PEER, PYBULLET, Case, Figure, growth, speedup
from benchmarks.speed.figures import by_case as group
from benchmarks.speed.timing import Samples


def figure(contender: str, *rates: float, num_envs: int = 64, mode: str = "stream") -> Figure:
    return Figure(Case("steps", 80, mode, num_envs), contender, Samples(rates))


def test_figures_of_one_case_stand_side_by_side() -> None:
    fast, slow, more = figure(FAST, 3.0), figure(PYBULLET, 1.0), figure(FAST, 9.0, num_envs=256)
    cases = group([fast, slow, more])
    assert list(cases.values()) == [{FAST: fast, PYBULLET: slow}, {FAST: more}]


def test_each_is_compared_with_its_own_rival() -> None:
    faster = speedup({FAST: figure(FAST, 8.0, 9.0), PYBULLET: figure(PYBULLET, 4.0, 3.0)})
    assert faster is not None
    assert faster.values == (2.0, 3.0)
    ours = speedup({PEER: figure(PEER, 4.0), OURS: figure(OURS, 2.0)})
    assert ours is not None
    assert ours.values == (0.5,)
    assert speedup({FAST: figure(FAST, 8.0), PEER: figure(PEER, 4.0)}) is None


def test_growth_in_proportion_has_exponent_one() -> None:
    # 64 environments in 2 ms, 256 in 8 ms, 1024 in 32 ms: always 32,000 steps per second.
    figures = [figure(FAST, 32_000.0, num_envs=n) for n in (64, 256, 1024)]
    (found,) = growth(figures)
    assert found.step_s == pytest.approx({64: 0.002, 256: 0.008, 1024: 0.032})
    assert found.exponent == pytest.approx(1.0)


def test_a_step_that_takes_twice_the_time_for_four_times_as_many_has_exponent_one_half() -> None:
    figures = [figure(FAST, 64 / 0.001), figure(FAST, 256 / 0.002, num_envs=256)]
    (found,) = growth([*figures, figure(FAST, 1.0, mode="frame grab")])
    assert (found.mode, found.size) == ("stream", 80)
    assert found.exponent == pytest.approx(0.5)


def test_json_has_the_median_and_every_round() -> None:
    assert figure(FAST, 1.0, 3.0, 2.0).plain() == {
        "what": "steps",
        "size": 80,
        "mode": "stream",
        "num_envs": 64,
        "contender": FAST,
        "per_second": 2.0,
        "range": [1.0, 3.0],
        "samples": [1.0, 3.0, 2.0],
    }
