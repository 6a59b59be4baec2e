"""Which episodes are counted when: no favour to the short ones."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import gymnasium
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from envs.environment import Environment
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import EpisodeBatch, concatenate
from trainers.saving.serialization import flatten, unflatten


class PileEnvironment(Environment):
    """Each episode that begins is the next of a pile: so long, and a success or not.

    Attributes:
        ended: places in the pile, in the order in which they ended.
    """

    def __init__(self, num_envs: int, lengths: Sequence[int], successes: Sequence[bool]):
        self.num_envs = num_envs
        self.single_observation_space = gymnasium.spaces.Dict({})
        self._lengths, self._successes = np.asarray(lengths), np.asarray(successes)
        self._place = np.zeros(num_envs, int)
        self._steps = np.zeros(num_envs, int)
        self._taken = 0
        self.ended: list[int] = []

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict]:
        self._take(np.ones(self.num_envs, bool))
        return {}, {}

    def step(self, actions: Any) -> tuple[Any, ...]:
        self._steps += 1
        done = self._steps == self._lengths[self._place]
        infos: dict[str, Any] = {
            "episode_metrics": {"success": self._successes[self._place], "place": self._place + 0}
        }
        if done.any():
            self.ended.extend(self._place[done].tolist())
            self._take(done)
            infos["final_obs"] = {}
        return {}, np.ones(self.num_envs), done, np.zeros(self.num_envs, bool), infos

    def state_dict(self) -> dict[str, Any]:
        return {"place": self._place, "steps": self._steps, "taken": self._taken}

    def load_state_dict(self, state: dict[str, Any]) -> dict[str, Any]:
        self._place, self._steps = state["place"].copy(), state["steps"].copy()
        self._taken = state["taken"]
        return {}

    def _take(self, where: np.ndarray) -> None:
        count = int(where.sum())
        self._place[where] = np.arange(self._taken, self._taken + count)
        self._steps[where] = 0
        self._taken += count


ACTIONS = np.zeros(0)
SHORT, LONG = 1, 3


def begun(env: PileEnvironment) -> EnvRunner:
    env_runner = EnvRunner(env)
    env_runner.reset()
    return env_runner


@given(
    num_envs=st.integers(1, 4),
    some_lengths=st.lists(st.integers(1, 6), min_size=1, max_size=30),
    steps=st.integers(0, 25),
    pops=st.sets(st.integers(0, 24)),
    resumed=st.sets(st.integers(0, 24), max_size=2),
)
def test_environments_side_by_side_count_like_one_that_plays_one_by_one(
    num_envs: int, some_lengths: list[int], steps: int, pops: set[int], resumed: set[int]
) -> None:
    lengths = np.resize(some_lengths, num_envs * (steps + 1))
    env = PileEnvironment(num_envs, lengths, lengths > 1)
    env_runner, parts = begun(env), []
    for step in range(steps):
        env_runner.step(ACTIONS)
        if step in pops:
            parts.append(env_runner.pop_finished())
        if step in resumed:
            env_runner = read_back(env_runner)
    played = concatenate([*parts, env_runner.pop_finished()])
    first_running = next(n for n in itertools.count() if n not in env.ended)
    complete = first_running // num_envs * num_envs
    assert played.number.tolist() == list(range(complete))
    np.testing.assert_array_equal(played.episode_metrics.get("place", []), played.number)
    np.testing.assert_array_equal(played.lengths, lengths[:complete])
    np.testing.assert_array_equal(played.rewards, lengths[:complete])


def read_back(env_runner: EnvRunner) -> EnvRunner:
    """Another with the same environment, and the state as a checkpoint returns it."""
    skeleton, arrays = flatten(env_runner.state_dict())
    stored = {name: array.copy() for name, array in arrays.items()}
    other = EnvRunner(env_runner.env)
    other.load_state_dict(unflatten(json.loads(json.dumps(skeleton)), stored))
    return other


def test_the_first_estimate_has_the_expectation_of_the_true_rate() -> None:
    # Every pile of 8 with its probability: successes are short and have a probability of 1/4.
    true_rate = Fraction(1, 4)
    counted = ended_first = Fraction()
    for pile in itertools.product([True, False], repeat=8):
        weight = Fraction(1)
        for success in pile:
            weight *= true_rate if success else 1 - true_rate
        env = PileEnvironment(2, [SHORT if success else LONG for success in pile], pile)
        env_runner = begun(env)
        for _ in range(LONG):
            env_runner.step(ACTIONS)
        successes = env_runner.pop_finished().successes
        counted += weight * Fraction(int(successes[:2].sum()), 2)
        ended_first += weight * Fraction(sum(pile[place] for place in env.ended[:2]), 2)
    assert counted == true_rate
    # Of the first two to end both are successes if the first two to begin are (1/16), or if one is
    # (6/16) and one follows it (1/4), before the failure has ended; else in the latter case one is.
    assert ended_first == Fraction(1, 16) + Fraction(6, 16) * (Fraction(1, 4) + Fraction(3, 8))


def test_a_policy_that_learns_nothing_shows_at_once_what_it_shows_later() -> None:
    # As random actions in the grasp task: 512 environments, 10 steps, a success in 5.5 %.
    rng, true_rate, count = np.random.default_rng(0), 0.055, 100_000
    first_success = rng.geometric(1 - (1 - true_rate) ** 0.1, count)
    successes = first_success <= 10
    env = PileEnvironment(512, np.minimum(first_success, 10), successes)
    env_runner, shown = begun(env), []
    for collection in range(40):
        for _ in range(8):
            env_runner.step(ACTIONS)
        if collection == 0:
            assert successes[env.ended].all()  # not one that failed has ended yet
        if len(released := env_runner.pop_finished()):
            shown.append(released)
    assert len(shown[0]) == 512
    for released in shown:
        deviation = np.sqrt(true_rate * (1 - true_rate) / len(released))
        assert abs(released.successes.mean() - true_rate) < 3.5 * deviation
        assert released.lengths.mean() > 9.5
    # Next to nothing waits for long.
    assert sum(map(len, shown)) > len(env.ended) - 3 * 512


def some_episodes(*rewards: float) -> EpisodeBatch:
    values = np.array(rewards)
    number = np.arange(len(rewards))
    return EpisodeBatch(number, values, values + 1, {"near": values + 2}, {"success": values > 1})


def test_episodes_are_joined_and_chosen() -> None:
    empty = concatenate([])
    joined = concatenate([empty, some_episodes(1.0, 2.0), empty, some_episodes(3.0)])
    assert joined.number.tolist() == [0, 1, 0]
    assert joined.rewards.tolist() == [1.0, 2.0, 3.0]
    assert joined.terms["near"].tolist() == [3.0, 4.0, 5.0]
    assert joined.successes.tolist() == [False, True, True]
    chosen = joined[np.array([True, False, True])]
    assert chosen.lengths.tolist() == [2.0, 4.0]
    assert chosen.episode_metrics["success"].tolist() == [False, True]
    assert joined[:2].rewards.tolist() == [1.0, 2.0]
    assert len(empty) == len(concatenate([empty])) == len(empty.successes) == 0


def test_episodes_that_say_nothing_of_success_are_none_beside_those_that_do() -> None:
    """And what else they say nothing of is not known."""
    tells = EpisodeBatch(*np.ones((3, 2)), {}, {"success": np.ones(2), "error_m": np.ones(2)})  # type: ignore[arg-type]
    silent = EpisodeBatch(*np.ones((3, 1)), {}, {})  # type: ignore[arg-type]
    for parts, success in (((silent, tells), [0, 1, 1]), ((tells, silent), [1, 1, 0])):
        metrics = concatenate(parts).episode_metrics
        assert metrics["success"].tolist() == success
        assert np.isnan(metrics["error_m"]).tolist() == [not known for known in success]
