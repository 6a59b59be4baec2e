"""The page on plugins does what it says: its examples run, and its tables name what there is."""

from __future__ import annotations

import copy
import importlib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from curricula.curriculum import FinishedEpisodes
from trainers import evaluation
from trainers import run as run_module
from trainers.algorithms.off_policy import OffPolicyAlgorithm
from trainers.evaluation import evaluate
from trainers.experience.env_runner import Step
from trainers.hookspecs import hookimpl
from trainers.networks.observations import Observations
from trainers.runfile.registry import (
    BUILT_IN_PLUGINS,
    Registries,
    load_registries,
    plugin_manager,
)
from trainers.runfile.settings import load_run
from trainers.saving.checkpoint import Checkpoints
from trainers.session import Session

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs/plugins.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
REINFORCE = '"""REINFORCE'
SAC_SECTION = PAGE[PAGE.index("### `ventosa_trainers`") :]


def block(beginning: str) -> str:
    (found,) = [each for each in BLOCKS if each.startswith(beginning)]
    return found


@pytest.fixture(scope="module")
def shown() -> SimpleNamespace:
    """The classes that the page shows, and the two that others bring."""
    known: dict[str, Any] = {"__name__": "shown"}
    for beginning in (
        '"""The curriculum `ladder`',
        '"""The environment `darts`',
        "from envs.evaluation import",
        REINFORCE,
    ):
        # Without this module's own future statements.
        exec(compile(block(beginning), "plugins.md", "exec", dont_inherit=True), known)
    return SimpleNamespace(**known)


@pytest.fixture(scope="module")
def with_shown(shown: SimpleNamespace) -> Registries:
    """What is built in, and what the page shows."""

    class Page:
        @hookimpl
        def ventosa_curricula(self) -> dict[str, type]:
            return {"ladder": shown.Ladder}

        @hookimpl
        def ventosa_environments(self) -> dict[str, type]:
            return {"darts": shown.Darts, "judged_darts": shown.JudgedDarts}

        @hookimpl
        def ventosa_trainers(self) -> dict[str, type]:
            return {"reinforce": shown.Reinforce}

    return load_registries(plugin_manager((*BUILT_IN_PLUGINS, Page())))


# -- the logger ----------------------------------------------------------------------------------


def test_the_logger_leaves_a_table_in_the_runs_folder(
    monkeypatch: pytest.MonkeyPatch, write_run: Callable[..., Path], learn: Callable[..., Any]
) -> None:
    known: dict[str, Any] = {"__name__": "shown"}
    exec(block('"""The logger `table`'), known)

    class Page:
        @hookimpl
        def ventosa_loggers(self) -> dict[str, type]:
            return {"table": known["Table"]}

    found = load_registries(plugin_manager((*BUILT_IN_PLUGINS, Page())))
    monkeypatch.setattr(run_module, "load_registries", lambda: found)
    pole = {"type": "gymnasium", "id": "CartPole-v1", "num_envs": 2}
    done = learn(write_run(pole, {"summary_freq": 32}, loggers=[{"type": "table"}]))
    lines = [line.split(",") for line in (done.results / "toy/curves.csv").read_text().splitlines()]
    assert "Environment/Cumulative Reward" in {tag for _, tag, _ in lines}
    assert sorted({int(step) for step, *_ in lines})[-1] <= 64


# -- the curriculum ------------------------------------------------------------------------------


def climb(ladder: Any, *successes: Sequence[int]) -> list[dict[str, int]]:
    """The states after each of some calls."""
    states = [ladder.initial_state()]
    for each in successes:
        episodes = FinishedEpisodes(np.zeros(len(each)), np.array(each, bool), 0.0)
        before = copy.deepcopy(states[-1])
        states.append(ladder.advance(states[-1], episodes))
        assert states[-2] == before
    return json.loads(json.dumps(states[1:]))  # type: ignore[no-any-return]


def test_the_ladder_climbs_by_streaks(shown: SimpleNamespace) -> None:
    settings = shown.Ladder.Settings(parameter="radius_m", rungs=(0.1, 0.3, 1.0), streak=3)
    ladder = shown.Ladder(settings)
    # A streak goes on over calls, ends with a failure, and what is left of a call counts no more.
    states = climb(ladder, [1, 1], [0, 1, 1], [1, 1, 1], [1, 1], [1], [1, 1, 1, 1])
    assert [(state["rung"], state["streak"]) for state in states] == [
        (0, 2),
        (0, 2),
        (1, 0),
        (1, 2),
        (2, 0),
        (2, 4),  # the last one never ends
    ]
    assert [ladder.parameters(state)["radius_m"] for state in states[1:3]] == [0.1, 0.3]
    assert ladder.final_parameters() == ladder.parameters(states[-1]) == {"radius_m": 1.0}
    assert ladder.lesson_name(states[2]) == "radius_m 0.3"


# -- the environment -----------------------------------------------------------------------------


def test_a_hit_ends_an_episode_and_so_does_the_last_dart(shown: SimpleNamespace) -> None:
    env = shown.Darts(shown.Darts.Settings(num_envs=3, darts=2), [], seed=0)
    seen, _ = env.reset(seed=1)
    far = np.array([0.0, 0.2], np.float32)
    first = seen["spot"] + [0 * far, far, 2 * far]
    after, reward, terminated, truncated, infos = env.step(first)
    np.testing.assert_allclose(reward, [0.0, -0.2, -0.4], atol=1e-6)
    assert (terminated.tolist(), truncated.tolist()) == ([True, False, False], [False] * 3)
    assert infos["episode_metrics"]["inside"].tolist() == [True, True, False]
    np.testing.assert_array_equal(infos["final_obs"]["spot"], seen["spot"])
    # Where an episode goes on the spot stays, and elsewhere there is another.
    assert (after["spot"] == seen["spot"]).all(axis=1).tolist() == [False, True, True]
    *_, terminated, truncated, _ = env.step(after["spot"] + [far, 0 * far, far])
    assert (terminated.tolist(), truncated.tolist()) == ([False, True, False], [False, False, True])


def test_the_wind_carries_darts_off_for_as_long_as_they_fly(shown: SimpleNamespace) -> None:
    env = shown.Darts(shown.Darts.Settings(num_envs=500, wind_m_s=2.0), [], seed=0)
    seen, _ = env.reset(seed=1)
    assert seen["wind"].std() == pytest.approx(2.0, rel=0.1)
    _, reward, *_ = env.step(seen["spot"])
    np.testing.assert_allclose(reward, -0.1 * np.linalg.norm(seen["wind"], axis=1), rtol=1e-4)


def test_what_was_learned_of_darts_goes_on_exactly(
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    with_shown: Registries,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run_module, "load_registries", lambda: with_shown)
    ladder = {"type": "ladder", "parameter": "radius_m", "rungs": [0.01, 0.3, 1.0], "streak": 4}
    hyper = {"learning_rate_schedule": "constant", "beta_schedule": "constant"}
    config = write_run(
        {"type": "darts", "num_envs": 4, "wind_m_s": 0.1},
        # Darts near the middle hit: the ladder is climbed.
        {"hyperparameters": hyper, "network_settings": {"initial_std": 0.01}},
        curriculum=ladder,
    )
    results = learn(config, "--run-id", "whole").results
    learn(config, "--run-id", "halves", "trainer.max_steps=32")
    resumed = learn(config, "--run-id", "halves", "--resume")
    assert resumed.code == 0, resumed.errors
    whole, halves = (
        Checkpoints(results / name / "checkpoints", keep=1).load_latest()
        for name in ("whole", "halves")
    )
    assert whole.state["curriculum"] == halves.state["curriculum"]
    assert whole.state["curriculum"]["rung"] > 0
    assert whole.weights.keys() == halves.weights.keys()
    assert all(torch.equal(whole.weights[name], halves.weights[name]) for name in whole.weights)


def test_judged_darts_are_judged_as_is_said_of_them(
    shown: SimpleNamespace,
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    with_shown: Registries,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (wind,) = shown.JudgedDarts.evaluation_options
    assert (wind.flag, wind.key) == ("--wind", "environment.wind_m_s")
    monkeypatch.setattr(run_module, "load_registries", lambda: with_shown)
    monkeypatch.setattr(evaluation, "load_registries", lambda: with_shown)
    learned = learn(write_run({"type": "judged_darts", "num_envs": 4}))
    assert learned.code == 0, learned.errors
    judged = evaluate("toy", episodes=8, overrides=[f"{wind.key}=5"], results_dir=learned.results)
    assert {"inside_rate", "distance_m", "success"} <= judged.report.keys()
    assert judged.figures["distance_m"].shown(0.0123) == "1.23 cm"


# -- the algorithm from nothing ------------------------------------------------------------------


@pytest.fixture
def reinforce_run(tmp_path: Path) -> Path:
    path = tmp_path / "pole.yaml"
    environment = {"type": "gymnasium", "id": "CartPole-v1", "num_envs": 2}
    trainer = {"trainer_type": "reinforce", "time_horizon": 8, "max_steps": 64}
    path.write_text(yaml.safe_dump({"environment": environment, "trainer": trainer}))
    return path


def test_reinforce_weighs_each_action_by_what_followed_it(
    reinforce_run: Path, with_shown: Registries
) -> None:
    run = load_run(reinforce_run, ["trainer.gamma=0.5"], with_shown)
    session = Session(run, with_shown)
    algorithm: Any = session.algorithm
    seen = [
        Observations({}, {"observation": torch.randn(2, 4, generator=torch.manual_seed(seed))})
        for seed in (0, 1)
    ]
    actions = torch.tensor([[0, 1], [1, 1]])
    rewards, ends = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[False, True], [False, False]])
    no = np.zeros(2, bool)
    algorithm._collected = [
        (seen[t], actions[t], Step(rewards[t], ends[t], no, no, None)) for t in (0, 1)
    ]
    follows = [[1.0 + 0.5 * 3.0, 2.0], [3.0, 4.0]]
    chosen = [
        algorithm.policy.log_probs(seen[t])[n, actions[t, n]].item() for t in (0, 1) for n in (0, 1)
    ]
    expected = -np.mean(np.array(chosen) * np.ravel(follows))
    statistics = algorithm.update(0.0)
    session.close()
    assert statistics == {"Losses/Policy Loss": pytest.approx(expected, rel=1e-5)}
    assert statistics.keys() == algorithm.tags.keys()


def test_what_reinforce_learned_goes_on_exactly(
    reinforce_run: Path,
    learn: Callable[..., Any],
    with_shown: Registries,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run_module, "load_registries", lambda: with_shown)
    results = learn(reinforce_run, "--run-id", "whole").results
    learn(reinforce_run, "--run-id", "halves", "trainer.max_steps=32")
    resumed = learn(reinforce_run, "--run-id", "halves", "--resume")
    assert resumed.code == 0, resumed.errors
    whole, halves = (
        Checkpoints(results / name / "checkpoints", keep=1).load_latest().weights
        for name in ("whole", "halves")
    )
    assert all(torch.equal(whole[name], halves[name]) for name in whole)


def test_darts_refuse_rewards_and_unknown_parameters(shown: SimpleNamespace) -> None:
    settings = shown.Darts.Settings(num_envs=2)
    with pytest.raises(ValueError, match="leave `rewards` out"):
        shown.Darts(settings, [object()], seed=0)
    with pytest.raises(ValueError, match=r"\['radius'\]; there are: \['radius_m'\]"):
        shown.Darts(settings, [], seed=0).set_parameters({"radius": 1.0})


# -- the algorithm -------------------------------------------------------------------------------


def unindented(code: str) -> str:
    """The lines that are not empty: a method may be shown without its class."""
    return "\n".join(line.strip() for line in code.splitlines() if line.strip())


def test_the_algorithm_is_shown_as_it_is() -> None:
    files = (REPOSITORY / "examples/ventosa-sac-plugin/ventosa_sac").glob("*.py")
    source = "\n".join(unindented(path.read_text()) for path in files)
    excerpts = re.findall(r"```python\n(.*?)```", SAC_SECTION, re.DOTALL)
    excerpts.remove(block(REINFORCE))
    assert len(excerpts) == 6
    for excerpt in excerpts:
        assert unindented(excerpt) in source


def test_the_algorithm_is_as_short_as_is_said() -> None:
    files = (REPOSITORY / "examples/ventosa-sac-plugin/ventosa_sac").glob("*.py")
    assert sum(len(path.read_text().splitlines()) for path in files) < 260


def test_the_tables_name_every_field_of_what_goes_to_and_fro() -> None:
    rows = re.findall(r"^\| `([\w.]+)\.([A-Z]\w+)` \| (.*) \|$", SAC_SECTION, re.MULTILINE)
    described = {name: (module, text) for module, name, text in rows if "algorithms" not in module}
    assert described.keys() == {
        "Observations",
        "FrameFeatures",
        "Step",
        "CollectedStep",
        "BehaviorOutput",
        "Rollout",
        "EpisodeBatch",
        "FinishedEpisodes",
        "GymTransition",
        "GraspTransition",
    }
    for name, (module, text) in described.items():
        cls = getattr(importlib.import_module(module), name)
        named = re.findall(r"`(\w+)`", text)
        own = [field.name for field in fields(cls)]
        assert [word for word in named if word in own] == own
        assert all(hasattr(cls, word) for word in set(named) - set(own))


def test_the_off_policy_base_asks_for_what_the_page_says() -> None:
    methods = re.findall(r"^\| `(_\w+)\(", SAC_SECTION, re.MULTILINE)
    abstract = {
        name
        for name, method in vars(OffPolicyAlgorithm).items()
        if getattr(method, "__isabstractmethod__", False)
    }
    assert set(methods) == abstract
