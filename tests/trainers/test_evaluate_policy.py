"""One policy in environments that play a script: every figure is worked out by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from envs.environment import Environment, EnvironmentFailure
from envs.evaluation import Evaluator, error, rate
from trainers import evaluation
from trainers.common.errors import UserError
from trainers.common.options import SEED_LIMIT
from trainers.common.stopping import StopRequested
from trainers.evaluation import FIRST_SEED, evaluate_policy

EPISODES = 3  # the first to begin: two of the first environment's, one of the second's
REWARD = [[1.0, 10.0], [2.0, 20.0], [3.0, 30.0], [4.0, 40.0], [5.0, 50.0]]
ENDS = [[0, 0], [1, 0], [0, 1], [1, 0], [0, 1]]
HIT = [[0, 1], [1, 0], [0, 1], [0, 1], [1, 1]]
GAP_M = [[0.5, 0.7], [0.1, 9.0], [9.0, 0.2], [0.4, 9.0], [9.0, 9.0]]


class Counting:
    """A policy whose actions and state are the number of its steps."""

    def __init__(self) -> None:
        self.states: list[Any] = []
        self.deterministic: list[bool] = []

    def predict(
        self, observations: Mapping[str, Any], state: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        self.states.append(None if state is None else state[:, 0].tolist())
        self.deterministic.append(deterministic)
        state = np.zeros((len(observations["x"]), 1)) if state is None else state
        return state.astype(np.float32), state + 1.0


class Check:
    def __init__(self) -> None:
        self.actions = 0

    def __call__(self, actions: np.ndarray) -> dict[str, np.ndarray]:
        first = np.arange(len(actions)) == 0
        self.actions += len(actions)
        return {"success": first, "slipped": ~first}

    def close(self) -> None:
        pass


class Pictures:
    file_names = ()

    def __init__(self) -> None:
        self.outcomes: list[Mapping[str, Any]] = []

    def add(self, actions: np.ndarray, outcomes: Mapping[str, Any]) -> None:
        self.outcomes += [outcomes] * len(actions)

    def files(self) -> Any:
        return iter(())


class Judging(Evaluator):
    figures = (rate("hit", "hits", key="hit_rate"), error("gap_m", "gap", "mm", 1000.0))


@pytest.fixture
def env(scripted: Callable[..., Environment], monkeypatch: pytest.MonkeyPatch) -> Environment:
    x = np.zeros((6, 2, 1))
    made = scripted(
        gymnasium.spaces.Dict({"x": Box(-1.0, 1.0, (1,), np.float32)}),
        {"x": x},
        REWARD,
        truncated=ENDS,
        final={"x": x[1:]},
        episode_metrics={"hit": HIT, "gap_m": GAP_M},
    )
    monkeypatch.setattr(made, "evaluator", Judging)
    return made


def test_figures_are_those_of_the_first_episodes_to_begin(env: Environment) -> None:
    policy = Counting()
    report = evaluate_policy(policy, env, EPISODES)
    # They end with rewards 3, 60 and 7 after 2, 3 and 2 steps; the fourth does not count.
    assert report == {
        "episodes": 3,
        "seed": 0,
        "hit_rate": pytest.approx(2 / 3),
        "gap_m": {"median": pytest.approx(0.2), "p95": pytest.approx(0.38)},
        "reward": pytest.approx(70 / 3),
        "reward_std": pytest.approx(np.std([3, 60, 7])),
        "episode_length": pytest.approx(7 / 3),
    }
    assert policy.deterministic == [True] * 5
    assert policy.states == [None, [1.0, 1.0], [0.0, 2.0], [1.0, 0.0], [0.0, 1.0]]


def test_the_first_action_is_judged_by_itself_where_it_counts(
    env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Judging, "judges_first_action", True)
    policy = Counting()
    report = evaluate_policy(policy, env, EPISODES)
    assert report["hit_rate"] == pytest.approx(2 / 3)
    # After the first step of three episodes: the first environment's, the second's, the first's.
    assert report["first_action_hit_rate"] == pytest.approx(1 / 3)
    assert report["gap_m"] == {"median": pytest.approx(0.5), "p95": pytest.approx(0.68)}
    assert policy.deterministic == [True] * 2 + [False] * 5
    assert policy.states[:3] == [None] * 3


def test_a_check_and_pictures_are_shown_as_many_first_actions_as_were_asked_for(
    env: Environment,
) -> None:
    check, pictures = Check(), Pictures()
    report = evaluate_policy(Counting(), env, EPISODES, check=check, pictures=pictures)
    assert check.actions == len(pictures.outcomes) == EPISODES
    assert report["check_rate"] == pytest.approx(2 / 3)  # the first of each of two batches
    assert report["check_failures"] == {"slipped": pytest.approx(1 / 3)}
    assert not [key for key in report if key.startswith("first_action")]
    undisturbed = evaluate_policy(Counting(), env, EPISODES)
    assert {key: report[key] for key in undisturbed} == undisturbed


def test_scenes_are_of_the_seed_and_no_runs_own(
    env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[Any] = []
    reset = env.reset
    monkeypatch.setattr(
        env, "reset", lambda *, seed=None: (seeds.append(seed), reset(seed=seed))[1]
    )
    last = SEED_LIMIT - 1
    for seed in (0, 1, last, last):
        evaluate_policy(Counting(), env, EPISODES, seed, check=Check())
    # Of each two batches of first actions, and the whole episodes.
    assert seeds[6:9] == seeds[9:]
    assert len(set(seeds)) == 9
    assert min(seeds) >= FIRST_SEED


def test_an_episode_without_an_end_is_told_with_what_to_set(
    env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "EPISODE_STEP_LIMIT", 3)
    evaluate_policy(Counting(), env, EPISODES)  # of at most three steps
    monkeypatch.setattr(env, "truncated", np.zeros((5, 2), bool))
    policy = Counting()
    with pytest.raises(EnvironmentFailure, match=r"not ended in 3 steps: set a limit.*max_epis"):
        evaluate_policy(policy, env, EPISODES)
    assert len(policy.deterministic) == 3


def test_a_stop_ends_the_whole_episodes(env: Environment) -> None:
    policy = Counting()
    with pytest.raises(StopRequested):
        evaluate_policy(policy, env, EPISODES, stop_requested=lambda: len(policy.deterministic) > 2)
    assert len(policy.deterministic) == 3


def test_a_figure_of_nothing_that_is_reported_names_the_nearest(
    env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Judging, "figures", (error("gap", "gap", "mm"),))
    with pytest.raises(UserError, match=r"'gap'.*not among.*did you mean 'gap_m'"):
        evaluate_policy(Counting(), env, EPISODES)
