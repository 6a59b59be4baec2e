"""Stepping the environments, with books kept by hand beside."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from encoders.spaces import RgbImage
from envs.environment import EnvironmentFailure
from trainers.common.errors import NonFiniteError
from trainers.common.stopping import StopRequested
from trainers.experience.env_runner import EnvRunner, Step

SPACE = gymnasium.spaces.Dict({"x": Box(-np.inf, np.inf, (1,), np.float32), "eye": RgbImage(2, 2)})
ACTIONS = np.zeros((2, 1))
REWARD = [[1, 10], [2, 20], [4, 40], [8, 80], [16, 160]]
ENDS = [[0, 0], [1, 0], [0, 1], [1, 1], [0, 0]]


def script(scripted: Any, **changes: Any) -> Any:
    time = np.arange(6.0)[:, None, None] * np.ones((1, 2, 1))
    eye = np.zeros((6, 2, 2, 2, 3))
    parts = {
        "observations": {"x": time, "eye": eye},
        "reward": REWARD,
        "truncated": ENDS,
        "final": {"x": 100 + time[1:], "eye": eye[1:]},
        "terms": {"near": np.multiply(REWARD, 0.25), "far": np.multiply(REWARD, 0.75)},
        "episode_metrics": {"success": ENDS, "error_m": np.multiply(REWARD, 0.1)},
    }
    return scripted(SPACE, **(parts | changes))


def begun(env: Any) -> EnvRunner:
    env_runner = EnvRunner(env)
    env_runner.reset()
    return env_runner


def test_episodes_are_added_up_over_resets(scripted: Any) -> None:
    env_runner = begun(script(scripted))
    for _ in range(4):
        env_runner.step(ACTIONS)
    episodes = env_runner.pop_finished()
    # In the order they began: the first env's steps 1-2, the second's 1-3, then 3-4 and 4.
    assert episodes.number.tolist() == [0, 1, 2, 3]
    assert episodes.rewards.tolist() == [1 + 2, 10 + 20 + 40, 4 + 8, 80]
    assert episodes.lengths.tolist() == [2, 3, 2, 1]
    assert episodes.terms["near"].tolist() == [0.75, 17.5, 3.0, 20.0]
    assert episodes.terms["far"].tolist() == [2.25, 52.5, 9.0, 60.0]
    assert episodes.episode_metrics["error_m"].tolist() == pytest.approx([0.2, 4.0, 0.8, 8.0])
    assert episodes.successes.tolist() == [True] * 4
    assert len(episodes) == 4
    assert env_runner.step_count == 8


def test_finished_episodes_are_taken_once(scripted: Any) -> None:
    env_runner = begun(script(scripted))
    assert len(env_runner.pop_finished()) == 0
    for expected in ([], [], [3.0, 70.0], [12.0, 80.0], []):
        env_runner.step(ACTIONS)
        assert env_runner.pop_finished().rewards.tolist() == expected


def test_environments_that_report_nothing_have_no_terms_and_no_success(scripted: Any) -> None:
    env_runner = begun(script(scripted, terms=None, episode_metrics=None))
    for _ in range(3):
        env_runner.step(ACTIONS)
    episodes = env_runner.pop_finished()
    assert episodes.terms == episodes.episode_metrics == {}
    assert episodes.successes.tolist() == [False, False]


def test_a_step_says_what_the_environment_said(scripted: Any) -> None:
    never, terminated = np.zeros((5, 2)), [[0, 0], [0, 1], *[[0, 0]] * 3]
    same = [[1, 0], [0, 1], *[[1, 1]] * 3]
    env = script(scripted, truncated=never, terminated=terminated, same_frame=same)
    env_runner = begun(env)
    first = env_runner.step(ACTIONS + 0.5)
    assert env.actions_taken[0].tolist() == [[0.5], [0.5]]
    assert first.final_observations is None
    assert first.same_frame.tolist() == [True, False]
    assert env_runner.observations["x"].flatten().tolist() == [1.0, 1.0]
    second = env_runner.step(ACTIONS)
    assert second.reward.tolist() == [2.0, 20.0]
    assert second.terminated.tolist() == [False, True]
    assert second.truncated.tolist() == [False, False]
    assert second.final_observations is not None
    assert second.final_observations["x"][1].tolist() == [102.0]
    assert env_runner.observations["x"].flatten().tolist() == [2.0, 2.0]


def test_frames_count_as_new_unless_the_environment_says_otherwise(scripted: Any) -> None:
    env_runner = begun(script(scripted))
    assert env_runner.step(ACTIONS).same_frame.tolist() == [False, False]


def test_a_stop_is_honoured_before_anything_is_done(scripted: Any) -> None:
    env = script(scripted)
    wanted = iter([False, True])
    env_runner = EnvRunner(env, lambda: next(wanted))
    env_runner.reset()
    env_runner.step(ACTIONS)
    with pytest.raises(StopRequested):
        env_runner.step(ACTIONS)
    assert env_runner.step_count == 2
    assert env.time == 1


def test_a_failure_has_its_step_and_is_none_where_the_run_is_to_stop(
    scripted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(actions: Any) -> Any:
        raise EnvironmentFailure("a process was killed by SIGTERM")

    stopping = iter([False, False, False, False, True])  # asked once more where it failed
    env = script(scripted)
    env_runner = EnvRunner(env, lambda: next(stopping))
    env_runner.reset()
    env_runner.step(ACTIONS)
    monkeypatch.setattr(env, "step", fail)
    with pytest.raises(EnvironmentFailure, match=r"^step 4: a process was killed by SIGTERM$"):
        env_runner.step(ACTIONS)
    with pytest.raises(StopRequested):
        env_runner.step(ACTIONS)


def poisoned(values: Any, at: tuple[int, ...], by: float) -> np.ndarray:
    array = np.array(values, np.float64)
    array[at] = by
    return array


def test_what_a_reset_fails_of_keeps_its_kind(
    scripted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class NoSceneError(EnvironmentFailure, ValueError):
        pass

    def reset(**options: Any) -> Any:
        raise NoSceneError("no scene fits")

    env_runner = begun(script(scripted))
    monkeypatch.setattr(env_runner.env, "reset", reset)
    with pytest.raises(
        NoSceneError, match=r"^no scene fits$"
    ):  # the settings' fault, for a session
        env_runner.reset()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_broken_reward_is_named_with_its_step_and_environment(scripted: Any, bad: float) -> None:
    env_runner = begun(script(scripted, reward=poisoned(REWARD, (1, 1), bad)))
    env_runner.step(ACTIONS)
    told = rf"^step 4: the reward of environment 1 is {bad}, and should be finite$"
    with pytest.raises(NonFiniteError, match=told):
        env_runner.step(ACTIONS)


def test_a_broken_term_is_named_rather_than_the_sum(scripted: Any) -> None:
    terms = {"near": poisoned(REWARD, (0, 0), np.nan), "far": REWARD}
    reward = poisoned(REWARD, (0, 0), np.nan)
    env_runner = begun(script(scripted, reward=reward, terms=terms))
    with pytest.raises(
        NonFiniteError, match=r"^step 2: the reward 'near' of environment 0 is nan, and"
    ):
        env_runner.step(ACTIONS)


def test_a_broken_observation_is_named_at_a_step_and_at_the_reset(scripted: Any) -> None:
    eye = np.zeros((6, 2, 2, 2, 3))
    x = poisoned(np.zeros((6, 2, 1)), (1, 1, 0), np.inf)
    env_runner = begun(script(scripted, observations={"x": x, "eye": eye}))
    with pytest.raises(
        NonFiniteError, match=r"^step 2: the observation 'x' of environment 1 is inf"
    ):
        env_runner.step(ACTIONS)
    x = poisoned(np.zeros((6, 2, 1)), (0, 0, 0), np.nan)
    with pytest.raises(
        NonFiniteError, match=r"^step 0: the observation 'x' of environment 0 is nan"
    ):
        begun(script(scripted, observations={"x": x, "eye": eye}))


def test_a_broken_last_observation_is_named_where_an_episode_ended(scripted: Any) -> None:
    eye = np.zeros((5, 2, 2, 2, 3))
    x = poisoned(np.full((5, 2, 1), np.nan), (1, 0, 0), 7.0)  # elsewhere it means nothing
    env_runner = begun(script(scripted, final={"x": x, "eye": eye}))
    env_runner.step(ACTIONS)
    env_runner.step(ACTIONS)
    with pytest.raises(
        NonFiniteError, match=r"^step 6: the observation 'x' of environment 1 is nan"
    ):
        env_runner.step(ACTIONS)


def test_a_truncated_episode_needs_its_last_observation(scripted: Any) -> None:
    env_runner = begun(script(scripted, final=None))
    env_runner.step(ACTIONS)
    with pytest.raises(
        EnvironmentFailure, match=r"^step 4: an episode was truncated, .* no `final_obs`"
    ):
        env_runner.step(ACTIONS)
    # Where it ended of its own, too, nothing would follow.
    env_runner = begun(script(scripted, final=None, terminated=ENDS))
    assert [env_runner.step(ACTIONS).done.any() for _ in range(2)] == [False, True]


@pytest.mark.parametrize("trainer_type", ["ppo", "trpo", "ddpg"])
def test_no_algorithm_learns_from_truncation_without_the_last_observation(
    make_algorithm: Any, monkeypatch: pytest.MonkeyPatch, trainer_type: str
) -> None:
    algorithm = make_algorithm(trainer_type)
    step = algorithm._env_runner.env.step

    def forgetful(actions: Any) -> Any:
        *rest, infos = step(actions)
        return *rest, {k: v for k, v in infos.items() if not k.endswith("final_obs")}

    monkeypatch.setattr(algorithm._env_runner.env, "step", forgetful)
    with pytest.raises(EnvironmentFailure, match="no `final_obs`"):
        algorithm.collect()


def test_going_back_to_a_state_of_other_environments_is_refused(scripted: Any) -> None:
    env_runner = begun(script(scripted))
    state = env_runner.state_dict()
    state["reward"] = np.zeros(3)
    with pytest.raises(ValueError, match=r"^it was saved with 3 environments, not 2$"):
        env_runner.load_state_dict(state)


def test_going_back_to_a_state_goes_on_with_the_same_books(scripted: Any) -> None:
    env = script(scripted)
    env_runner = begun(env)
    env_runner.step(ACTIONS)
    state = env_runner.state_dict()
    kept = copy.deepcopy(state)
    env_runner.step(ACTIONS)
    env_runner.step(ACTIONS)
    np.testing.assert_equal(state, kept)  # playing on changes nothing of what was handed out
    other = EnvRunner(script(scripted))
    other.load_state_dict(state)
    assert other.step_count == 2
    assert other.observations["x"].flatten().tolist() == [1.0, 1.0]
    other.step(ACTIONS)
    other.step(ACTIONS)
    episodes = other.pop_finished()
    assert episodes.rewards.tolist() == [3, 70]
    assert episodes.lengths.tolist() == [2, 3]
    assert episodes.terms["near"].tolist() == [0.75, 17.5]
    np.testing.assert_equal(state, kept)


class Parameterized:
    """Stands in for an environment that takes parameters."""

    def __init__(self, env: Any):
        self.env, self.parameters = env, []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def set_parameters(self, parameters: Any) -> None:
        self.parameters.append(parameters)


def test_parameters_are_those_of_the_episodes_that_begin_after_them(scripted: Any) -> None:
    env: Any = Parameterized(script(scripted))
    env_runner = EnvRunner(env)
    env_runner.set_parameters({"scale": 1.0})
    assert env_runner.parameters_from == 0
    env_runner.reset()
    for _ in range(2):
        env_runner.step(ACTIONS)
    env_runner.set_parameters({"scale": 2.0})
    assert env.parameters == [{"scale": 1.0}, {"scale": 2.0}]
    assert env_runner.parameters_from == 3  # 1 and 2 run, 3 begins with the next step
    state = env_runner.state_dict()
    env_runner.step(ACTIONS)
    env_runner.set_parameters({"scale": 3.0})
    assert env_runner.parameters_from == 4
    other = EnvRunner(script(scripted))
    other.load_state_dict(state)
    assert other.parameters_from == 3


def test_episodes_that_a_reset_cuts_off_keep_nothing_waiting(scripted: Any) -> None:
    env_runner = begun(script(scripted))
    env_runner.step(ACTIONS)
    env_runner.reset()
    for _ in range(3):
        env_runner.step(ACTIONS)
    assert env_runner.pop_finished().number.tolist() == [2, 3]


def test_a_reset_counts_nothing_of_what_it_cuts_off(scripted: Any) -> None:
    """The first environment has begun a second episode by then."""
    env_runner = begun(script(scripted))
    for _ in range(2):
        env_runner.step(ACTIONS)
    env_runner.reset()
    assert len(env_runner.pop_finished()) == 0  # its first episode had ended, and waited
    for _ in range(3):
        env_runner.step(ACTIONS)
    episodes = env_runner.pop_finished()
    assert episodes.number.tolist() == [4, 5]  # 3 was never begun: both are of one cohort
    assert episodes.rewards.tolist() == [1 + 2, 10 + 20 + 40]
    assert episodes.lengths.tolist() == [2, 3]
    assert episodes.terms["near"].tolist() == [0.75, 17.5]


def test_only_what_was_truncated_alone_is_cut_off() -> None:
    terminated, truncated = np.array([[0, 1, 0, 1], [0, 0, 1, 1]], bool)
    step = Step(np.zeros(4), terminated, truncated, np.zeros(4, bool), None)
    assert step.cut_off.tolist() == [False, False, True, False]
    assert step.done.tolist() == [False, True, True, True]


def test_an_end_of_both_kinds_needs_no_last_observation(scripted: Any) -> None:
    env_runner = begun(script(scripted, terminated=ENDS, final={}))
    env_runner.step(ACTIONS)
    step = env_runner.step(ACTIONS)
    assert step.done.tolist() == [True, False]
    assert step.final_observations is None


def test_a_state_from_before_episodes_had_numbers_goes_on(scripted: Any) -> None:
    env_runner = begun(script(scripted))
    env_runner.step(ACTIONS)
    state = env_runner.state_dict()
    for name in ("number", "begun", "parameters_from", "cohorts"):
        del state[name]
    other = EnvRunner(script(scripted))
    other.load_state_dict(state)
    assert other.parameters_from == 2  # how the running ones were begun is not known
    for _ in range(2):
        other.step(ACTIONS)
    episodes = other.pop_finished()
    assert (episodes.number.tolist(), episodes.rewards.tolist()) == ([0, 1], [3.0, 70.0])
