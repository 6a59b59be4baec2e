"""How both sides of the learning benchmark are judged, and what is made of it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from benchmarks.command import ROOT
from benchmarks.learning.cases import (
    CASES,
    LONG_CASES,
    PEER_NAMES,
    PLUGINS,
    RUN_FILES,
    Case,
    Entry,
)
from benchmarks.learning.evaluation import Referee, returns
from envs.environment import Environment
from trainers.networks.network import NetworkSettings
from trainers.runfile.settings import Component

pytest.importorskip("matplotlib")
pytest.importorskip("scipy")

from benchmarks.learning import __main__ as learning
from benchmarks.learning.report import HEAD, half_interval, rows

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


def test_a_row_has_means_and_median_speeds_of_both_sides() -> None:
    row = ["pendulum", "1,000", "ppo", "3", "-160 ± 25", "-170 ± 25", "333", "333"]
    assert rows(RESULTS) == [row]
    assert len(HEAD) == len(row)


@pytest.mark.parametrize("case", CASES + LONG_CASES, ids=lambda case: f"{case.name}-{case.steps}")
def test_every_case_has_a_run_file_and_a_peer(case: Case) -> None:
    plugin = PLUGINS.get(case.algorithm)
    if plugin is None:
        assert case.run_file.parent == RUN_FILES
    else:
        assert case.run_file == ROOT / plugin / "config" / f"{case.task}.yaml"
    if plugin is not None and not (ROOT / plugin).exists():
        pytest.skip("the plugin is not in this tree")
    assert case.run_file.is_file()
    assert case.algorithm in PEER_NAMES


def test_result_files_tell_case_side_and_seed() -> None:
    entry = Entry(Case("sac", "pendulum", 20_000, 3), "peer", 2)
    assert entry.name == "pendulum_sac-20000-peer-2"


def without(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Takes trainers away, as if their plugins were not installed."""
    found = learning.load_registries()
    left = {k: v for k, v in found.trainers.entries.items() if k not in names}
    fewer = replace(found, trainers=replace(found.trainers, entries=left))
    monkeypatch.setattr(learning, "load_registries", lambda: fewer)


def test_an_algorithm_that_is_not_installed_is_left_out_or_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without(monkeypatch, "sac")
    install = "pip install -e examples/ventosa-sac-plugin"
    assert learning.trainable(None) == {"ppo", "trpo", "ddpg"}
    assert install in capsys.readouterr().out
    assert learning.trainable(["ppo"]) == {"ppo"}
    assert not capsys.readouterr().out
    assert learning.main(["--algorithms", "sac", "ppo"]) == 2
    assert install in capsys.readouterr().err


def test_the_command_reports_on_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- learning -->\nold\n<!-- end of learning -->\nafter\n")
    for one in RESULTS:
        case = Case("ppo", "pendulum", 100_000)
        file = tmp_path / f"{Entry(case, one['side'], one['seed']).name}.json"
        file.write_text(json.dumps(one))
    chosen = ["--algorithms", "ppo", "--tasks", "pendulum", "--seeds", "0", "1", "2"]
    written = ["--results", str(tmp_path), "--page", str(page), "--pictures", str(tmp_path / "new")]
    assert learning.main([*chosen, *written]) == 0
    assert "-160 ± 25" in capsys.readouterr().out
    text = page.read_text()
    assert text.startswith("before\n<!-- learning -->\n| task |")
    assert "| pendulum | 1,000 | ppo | 3 | -160 ± 25 | -170 ± 25 | 333 | 333 |" in text
    assert text.endswith("<!-- end of learning -->\nafter\n")
    assert (tmp_path / "new" / "learning_ppo.png").stat().st_size > 1000


def test_long_cases_have_a_table_of_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- learning -->\nold\n<!-- end of learning -->\n"
        "<!-- learning long -->\nold\n<!-- end of learning long -->\n"
    )
    for one in RESULTS:
        case = {"algorithm": "trpo", "task": "walker2d", "steps": 300_000}
        file = tmp_path / f"walker2d_trpo-300000-{one['side']}-{one['seed']}.json"
        file.write_text(json.dumps(one | {"case": case}))
    chosen = ["--long", "--algorithms", "trpo", "--tasks", "walker2d", "--seeds", "0", "1", "2"]
    written = ["--results", str(tmp_path), "--page", str(page), "--pictures", str(tmp_path)]
    assert learning.main([*chosen, *written]) == 0
    text = page.read_text()
    assert text.startswith("<!-- learning -->\nold\n<!-- end of learning -->\n")
    assert "| walker2d | 300,000 | trpo | 3 | -160 ± 25 |" in text
    assert (tmp_path / "learning_long_trpo.png").exists()


def test_the_peer_of_a_plugin_is_found_by_its_name_and_takes_its_settings() -> None:
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("sb3_contrib")
    from benchmarks.learning.theirs import build
    from benchmarks.peers import PeerVecEnv

    hyper = SimpleNamespace(
        batch_size=64, buffer_size=1000, buffer_init_steps=10, learning_rate=3e-4, gamma=0.97
    )
    hyper.tau, hyper.updates_per_step, hyper.init_entropy_coefficient = 0.01, 0.5, 0.25
    networks = NetworkSettings(hidden_units=32, num_layers=1, activation="tanh")
    settings = SimpleNamespace(hyperparameters=hyper, network_settings=networks)
    run: Any = SimpleNamespace(trainer=Component("sac", object, settings), seed=3)  # type: ignore[arg-type]
    env = Counting()
    env.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
    model: Any = build(run, PeerVecEnv(env))
    assert type(model).__name__ == "SAC"
    assert (model.batch_size, model.buffer_size, model.learning_starts) == (64, 1000, 10)
    assert (model.learning_rate, model.gamma, model.tau) == (3e-4, 0.97, 0.01)
    assert (model.gradient_steps, model.train_freq.frequency) == (1, 1)  # half of two environments
    assert model.log_ent_coef.exp().item() == pytest.approx(0.25)  # learned, from there
    assert "Tanh" in repr(model.actor)
    assert "out_features=32" in repr(model.critic)


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
