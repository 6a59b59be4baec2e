"""How both sides of the learning benchmark are judged, and what is made of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from benchmarks.learning.cases import CASES, Case
from benchmarks.learning.evaluation import Referee, returns
from envs.environment import Environment

pytest.importorskip("matplotlib")
pytest.importorskip("scipy")

from benchmarks.learning.report import draw, half_interval, summaries, write_page

LENGTHS = (2, 3)


class Counting(Environment):
    """Two environments: the reward is the action, and episodes take two and three steps."""

    def __init__(self) -> None:
        self.num_envs = 2
        self.single_observation_space = Dict({"step": Box(0.0, 9.0, (1,), np.float32)})
        self.seeds: list[Any] = []

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict]:
        self.seeds.append(seed)
        self._steps = np.zeros(2)
        return {"step": self._steps[:, None].copy()}, {}

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        self._steps += 1
        done = self._steps >= LENGTHS
        self._steps[done] = 0
        never = np.zeros(2, bool)
        return (
            {"step": self._steps[:, None].copy()},
            actions,
            done & [True, False],
            never | (done & [False, True]),
            {},
        )


def act(observations: Mapping[str, np.ndarray]) -> np.ndarray:
    """The steps so far: rewards 0, 1 in the first environment, and 0, 1, 2 in the second."""
    return observations["step"][:, 0].astype(float)


def test_returns_are_of_as_many_episodes_in_each_environment() -> None:
    env = Counting()
    assert sorted(returns(env, act, 2)) == [1.0, 1.0, 3.0, 3.0]
    returns(env, act, 1)
    assert env.seeds[0] == env.seeds[1] is not None


def test_the_referee_looks_at_intervals_and_stops_the_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = iter([10.0, 14.0, 20.0, 21.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    referee = Referee(Counting(), interval=100)
    referee.start()
    for step in (60, 130, 190):
        referee.look(step, act)
    assert referee.stop() == 5.0  # 10 to 14, and 20 to 21
    assert referee.curve == [(130, 2.0)]


def test_the_interval_by_hand() -> None:
    # Student's t for 2 and 9 degrees of freedom, from a printed table.
    assert half_interval([1.0, 2.0, 3.0]) == pytest.approx(4.303 / math.sqrt(3.0), rel=1e-3)
    assert half_interval([-1.0, 1.0] * 5) == pytest.approx(2.262 / 3.0, rel=1e-3)
    assert math.isnan(half_interval([1.0]))


def result(side: str, seed: int, final: float) -> dict[str, Any]:
    case = {"algorithm": "ppo", "task": "pendulum", "steps": 1000}
    curve = [[500, final - 100.0], [1024, final]]
    return {"case": case, "side": side, "seed": seed, "seconds": 2.0 + seed} | {
        "final_return": final,
        "curve": curve,
    }


RESULTS = [
    result(side, seed, offset - 10.0 * seed)
    for side, offset in (("ventosa", -150.0), ("peer", -160.0))
    for seed in range(3)
]


def test_a_summary_has_means_and_speeds_of_both_sides() -> None:
    (summary,) = summaries(RESULTS)
    assert summary.sides["ventosa"].mean == pytest.approx(-160.0)
    assert summary.sides["peer"].mean == pytest.approx(-170.0)
    assert summary.sides["peer"].steps_per_second == pytest.approx(1000 / 3.0)


def test_the_page_keeps_what_is_around_the_table(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- learning -->\nold\n<!-- end of learning -->\nafter\n")
    write_page(page, summaries(RESULTS))
    text = page.read_text()
    assert text.startswith("before\n<!-- learning -->\n| task |")
    assert text.endswith("<!-- end of learning -->\nafter\n")
    assert "| pendulum | 1,000 | ppo | 3 | -160 ± 25 | -170 ± 25 | 333 | 333 |" in text
    assert "old" not in text


def test_curves_are_drawn(tmp_path: Path) -> None:
    draw(RESULTS, tmp_path)
    assert (tmp_path / "learning_ppo.png").stat().st_size > 1000


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_case_has_a_run_file(case: Case) -> None:
    assert case.run_file.is_file()


def test_the_peers_side_learns(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("sb3_contrib")
    from benchmarks.learning.theirs import learn
    from trainers.runfile.registry import load_registries
    from trainers.runfile.settings import load_run
    from trainers.session import build_environment

    registries = load_registries()
    case = Case("ppo", "cartpole", 1)
    short = ["trainer.max_steps=64", "trainer.hyperparameters.buffer_size=64"]
    run = load_run(case.run_file, [*short, "trainer.hyperparameters.batch_size=32"], registries)
    env = build_environment(run, 0)
    chosen = learn(run, registries, Referee(env, 10))
    observations, _ = env.reset(seed=0)
    assert env.action_space.contains(chosen(observations))
    env.close()
